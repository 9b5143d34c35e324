"""The result of docs/plant.md is what scripts/fit_paper_plant.py finds."""

import importlib
import math
import re
from pathlib import Path

import pytest

from straightcomp_ros.parameters.parameter_file import shipped_parameters

REPOSITORY = Path(__file__).resolve().parents[3]
PAGE = (REPOSITORY / "docs" / "plant.md").read_text(encoding="utf-8")
CASES = {"linear control (9)": (0.0, False), "smc": (300.0, True), "smc, literal": (300.0, False)}
"""By the first cell of a row: slope ρ/ε in 1/s, and whether the map's rates are fed forward."""


@pytest.fixture(scope="module")
def fit():
    with pytest.MonkeyPatch.context() as patch:
        # The script imports its neighbour.
        patch.syspath_prepend(str(REPOSITORY / "scripts"))
        yield importlib.import_module("fit_paper_plant")


@pytest.mark.parametrize("name", CASES)
def test_a_row_of_the_result_is_what_the_script_finds(name, fit):
    told = [float(number) for number in re.findall(r"[\d.]+", _cell(name))]
    slope, feedforward = CASES[name]
    found = fit.Stroke().errors(fit.plant_with(0.43), fit.law(slope, feedforward=feedforward))
    assert found.median == pytest.approx(told[0], abs=0.03)
    assert told[1] - 0.05 < found.min <= found.max < told[2] + 0.05


def test_the_fitted_friction_is_the_shipped_one():
    (coulomb, static) = re.search(r"F_C = ([\d.]+) N, F_S = ([\d.]+) N, literal", PAGE).groups()
    stage = shipped_parameters()["stage"]
    assert stage["friction.coulomb"] == float(coulomb)
    assert stage["friction.static"] == float(static)


@pytest.mark.nightly
@pytest.mark.parametrize("delay, bandwidth", [(0.5, 500.0), (1.0, 200.0)])
def test_the_steepest_stable_boundary_layer_is_that_of_the_page(delay, bandwidth, fit):
    line = next(line for line in PAGE.splitlines() if line.startswith(f"| {delay:g} | {bandwidth:g} |"))
    told = float(re.findall(r"(\d+) /s", line)[-1])
    assert math.isclose(fit.stable_slope(delay, bandwidth), told, abs_tol=15.0)


def _cell(name: str) -> str:
    return next(line for line in PAGE.splitlines() if line.startswith(f"| {name} |")).split("|")[3]
