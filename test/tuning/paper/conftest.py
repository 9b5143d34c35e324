"""The shipped machine, and what is computed with it once for all tests."""

import contextlib
import io
import json

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.tuning.paper import all_figures
from straightcomp_ros.tuning.paper.machine import DELAY, Machine, machine_from
from straightcomp_ros.tuning.verbs import reproduce

SLOW = ("figure_4.png", "beyond_figure_4.png", "figure_8.png")
"""Figures that only the nightly reproduction computes."""


@pytest.fixture(scope="session")
def machine() -> Machine:
    values = shipped_parameters()
    values["stage"]["drive.delay"] = DELAY
    return machine_from(values)


def reproduced(folder, names) -> dict:
    """What `straightcomp reproduce --json` prints of these figures."""
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        for module in (all_figures, reproduce):
            patch.setattr(module, "FIGURES", {name: all_figures.FIGURES[name] for name in names})
        assert main(["reproduce", "--json", "-o", str(folder / "new")]) == 0
    return json.loads(printed.getvalue(), parse_constant=pytest.fail)


@pytest.fixture(scope="session")
def quick(tmp_path_factory) -> dict:
    names = [name for name in all_figures.FIGURES if name not in SLOW]
    return reproduced(tmp_path_factory.mktemp("quick"), names)


@pytest.fixture(scope="session")
def whole(tmp_path_factory) -> dict:
    return reproduced(tmp_path_factory.mktemp("whole"), list(all_figures.FIGURES))
