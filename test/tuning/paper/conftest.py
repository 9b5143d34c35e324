"""The shipped machine, and what is computed with it once for all tests."""

import contextlib
import io
import json

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.tuning.paper.machine import Machine, paper_machine
from straightcomp_ros.tuning.verbs import reproduce

SLOW = ("figure_4.png", "beyond_figure_4.png", "figure_8.png")
"""Figures that only the nightly reproduction computes."""


@pytest.fixture(scope="session")
def machine() -> Machine:
    return paper_machine()


def reproduced(folder, slow: tuple[str, ...]) -> dict:
    """What `straightcomp reproduce --json` prints without the figures ``slow``."""
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        chosen = {name: compute for name, compute in reproduce.FIGURES.items() if name not in slow}
        patch.setattr(reproduce, "FIGURES", chosen)
        assert main(["reproduce", "--json", "-o", str(folder / "new")]) == 0
    return json.loads(printed.getvalue(), parse_constant=pytest.fail)


@pytest.fixture(scope="session")
def quick(tmp_path_factory) -> dict:
    return reproduced(tmp_path_factory.mktemp("quick"), SLOW)


@pytest.fixture(scope="session")
def whole(tmp_path_factory) -> dict:
    return reproduced(tmp_path_factory.mktemp("whole"), ())
