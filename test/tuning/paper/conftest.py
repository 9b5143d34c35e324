"""The shipped machine, and what is computed with it once for all tests."""

import json

import pytest
from verbs import ran

from straightcomp_ros.tuning.paper.machine import Machine, paper_machine
from straightcomp_ros.tuning.verbs import reproduce

SLOW = ("figure_4.png", "beyond_figure_4.png", "figure_8.png")
"""Figures that only the nightly reproduction computes."""


@pytest.fixture(scope="session")
def machine() -> Machine:
    return paper_machine()


def reproduced(folder, slow: tuple[str, ...]) -> dict:
    """What `straightcomp reproduce --json` prints without the figures ``slow``."""
    with pytest.MonkeyPatch.context() as patch:
        chosen = {name: compute for name, compute in reproduce.FIGURES.items() if name not in slow}
        patch.setattr(reproduce, "FIGURES", chosen)
        code, out, err = ran("reproduce", "--json", "-o", folder / "new")
    assert code == 0, err
    return json.loads(out, parse_constant=pytest.fail)


@pytest.fixture(scope="session")
def quick(tmp_path_factory) -> dict:
    return reproduced(tmp_path_factory.mktemp("quick"), SLOW)


@pytest.fixture(scope="session")
def whole(tmp_path_factory) -> dict:
    return reproduced(tmp_path_factory.mktemp("whole"), ())
