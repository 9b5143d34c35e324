"""`straightcomp reproduce`: its claims and pictures; docs/paper.md, docs/evidence/plant.md print what it computes."""

import math
import re
from pathlib import Path

import pytest
from places import cells, line_of, page

from scripts import fit_paper_plant as fit
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.tuning.paper.figure import Claim, legend_below, sheet

PAPER, PLANT = page("paper"), page("evidence/plant")


@pytest.mark.parametrize("ours, within", [(1.0, True), (1.25, True), (0.75, True), (1.26, False), (math.nan, False)])
def test_a_claim_holds_up_to_its_tolerance_where_the_paper_prints_a_number(ours, within):
    shown = Claim("a", ours, "m", "", 1.0, tolerance=0.25).to_display()
    assert shown["within"] is within and shown["ours"] == (None if math.isnan(ours) else ours)
    without = Claim("a", ours, "m", "").to_display()
    assert without["within"] is without["tolerance"] is without["paper"] is None


def test_a_legend_below_a_sheet_covers_no_axes_and_nothing_of_their_labels():
    figure, axes = sheet("a title", "ab;cc", (12.0, 8.0))
    for one in axes:
        one.plot([0.0, 1.0], label="a line")
        one.set_xlabel("time / s")
    legend_below(figure, *axes[0].get_legend_handles_labels())
    figure.draw_without_rendering()
    top = figure.legends[0].get_window_extent().y1
    assert 0.0 < top < min(one.get_tightbbox().y0 for one in axes)


@pytest.mark.parametrize("output", ["quick", pytest.param("whole", marks=pytest.mark.nightly)])
def test_json_holds_claims_and_pictures_and_a_number_that_disagrees_is_no_failure(output, request):
    printed = request.getfixturevalue(output)
    assert {claim["within"] for claim in printed["claims"]} == {True, False, None}
    for claim in printed["claims"]:
        assert {"name", "paper", "ours", "range", "unit", "tolerance", "within", "note"} == set(claim) and claim["note"]
        assert (claim["paper"] is None) == (claim["within"] is None)
    assert len(printed["figures"]) >= 6
    for picture in map(Path, printed["figures"]):
        # An empty sheet of this size is below 20 kB.
        assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size > 50_000


ROWS = [
    [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
    for line in PAPER.partition("## The numbers")[2].partition("\n## ")[0].splitlines()
    if line.startswith("| ") and not line.startswith("| claim")
]


def numbers(cell: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?[\d.]+", cell.replace("−", "-"))]


def of_the_same_row(claims: list[dict], name: str) -> list[dict]:
    """Claims under one heading of the page, which gathers our laws in one row."""
    figure = re.match(r"(beyond )?Fig. \d", name)
    found = [one for one in claims if figure is None or one["name"].startswith(figure[0])]
    if "each of our laws" in name:
        what = "region of recovery" if "region" in name else "recovers from"
        return [one for one in found if what in one["name"] and "(9)" not in one["name"]]
    return found


def marked(row: list[str]):
    """Rows of slow figures, which ``quick`` lacks, are nightly."""
    slow = re.match(r"beyond|Fig\. [48]", row[0]) is not None
    return pytest.param("whole" if slow else "quick", row, id=row[0], marks=[pytest.mark.nightly] * slow)


@pytest.mark.parametrize("computed, row", [marked(row) for row in ROWS])
def test_a_row_of_the_page_is_a_claim_of_reproduce(computed, row, request):
    name, paper, ours, _, agrees = row
    claims = of_the_same_row(request.getfixturevalue(computed)["claims"], name)
    on_page = [{"yes": 1.0, "no": 0.0}[ours]] if ours in ("yes", "no") else numbers(ours)
    if "each of our laws" in name:
        found = [claim["ours"] for claim in claims]
        assert [min(found), max(found)] == pytest.approx([min(on_page), max(on_page)], abs=0.006)
        return
    near = [claim for claim in claims if claim["ours"] == pytest.approx(on_page[0], rel=0.05, abs=1e-9)]
    assert near, f"{on_page[0]} is none of {[claim['ours'] for claim in claims]}"
    if len(on_page) == 3:
        (claim,) = (claim for claim in near if claim["range"])
        assert list(claim["range"]) == pytest.approx(on_page[1:], rel=0.06)
    if paper not in ("", "yes", "no"):
        assert any(claim["paper"] == pytest.approx(numbers(paper)[0]) for claim in near)
    if agrees:
        assert any(claim["within"] is agrees.startswith("yes") for claim in near)


CASES = {"linear control (9)": (0.0, False), "smc": (300.0, True), "smc, literal": (300.0, False)}
"""By the first cell of a row: slope ρ/ε in 1/s, and whether the map's rates are fed forward."""


@pytest.mark.parametrize("name", CASES)
def test_a_row_of_the_result_is_what_the_script_finds(name):
    on_page = numbers(cells(line_of(PLANT, name))[2])
    slope, feedforward = CASES[name]
    found = fit.Stroke().errors(fit.plant_with(0.43), fit.law(slope, feedforward=feedforward))
    assert found.median == pytest.approx(on_page[0], abs=0.03)
    assert on_page[1] - 0.05 < found.min <= found.max < on_page[2] + 0.05


def test_the_fitted_friction_is_the_shipped_one():
    (coulomb, static) = re.search(r"F_C = ([\d.]+) N, F_S = ([\d.]+) N, literal", PLANT).groups()
    stage = shipped_parameters()["stage"]
    assert stage["friction.coulomb"] == float(coulomb)
    assert stage["friction.static"] == float(static)


@pytest.mark.nightly
@pytest.mark.parametrize("delay, bandwidth", [(0.5, 500.0), (1.0, 200.0)])
def test_the_steepest_stable_boundary_layer_is_that_of_the_page(delay, bandwidth):
    on_page = float(re.findall(r"(\d+) /s", line_of(PLANT, f"{delay:g} | {bandwidth:g}"))[-1])
    assert math.isclose(fit.stable_slope(delay, bandwidth), on_page, abs_tol=15.0)
