"""The shipped machine, and what is computed with it once for all tests."""

import contextlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.tuning.paper.machine import DELAY, Machine, machine_from


@dataclass(frozen=True)
class Output:
    """What `straightcomp reproduce --json` left behind."""

    exit_code: int
    printed: dict[str, Any]
    folder: Path


@pytest.fixture(scope="session")
def machine() -> Machine:
    values = shipped_parameters()
    values["stage"]["drive.delay"] = DELAY
    return machine_from(values)


@pytest.fixture(scope="session")
def output(tmp_path_factory: pytest.TempPathFactory) -> Output:
    folder = tmp_path_factory.mktemp("reproduce") / "new"
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exit_code = main(["reproduce", "--json", "-o", str(folder)])
    return Output(exit_code, json.loads(printed.getvalue()), folder)
