"""The shipped machine, and what is computed with it once for all tests."""

import contextlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.tuning.paper import all_figures
from straightcomp_ros.tuning.paper.machine import DELAY, Machine, machine_from
from straightcomp_ros.tuning.verbs import reproduce


@dataclass(frozen=True)
class Output:
    """What `straightcomp reproduce --json` left behind."""

    exit_code: int
    printed: dict[str, Any]
    figures: Mapping[str, Any]
    folder: Path


@pytest.fixture(scope="session")
def machine() -> Machine:
    values = shipped_parameters()
    values["stage"]["drive.delay"] = DELAY
    return machine_from(values)


SLOW = ("figure_4.png", "beyond_figure_4.png", "figure_8.png")
"""Figures that only the nightly reproduction computes."""


def reproduced(folder: Path, figures: Mapping[str, Any]) -> Output:
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        for module in (all_figures, reproduce):
            patch.setattr(module, "FIGURES", figures)
        exit_code = main(["reproduce", "--json", "-o", str(folder)])
    return Output(exit_code, json.loads(printed.getvalue()), figures, folder)


@pytest.fixture(scope="session")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Output:
    figures = {name: figure for name, figure in all_figures.FIGURES.items() if name not in SLOW}
    return reproduced(tmp_path_factory.mktemp("quick") / "new", figures)


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Output:
    return reproduced(tmp_path_factory.mktemp("whole") / "new", all_figures.FIGURES)
