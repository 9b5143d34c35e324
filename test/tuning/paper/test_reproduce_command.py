"""`straightcomp reproduce`: its claims and pictures; docs/paper.md and docs/plant.md print what is computed."""

import importlib
import json
import math
import re
from pathlib import Path

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.tuning.paper.all_figures import Reproduction
from straightcomp_ros.tuning.paper.figure import Claim
from straightcomp_ros.tuning.verbs import reproduce


@pytest.mark.parametrize(
    "paper, ours, within",
    [
        (1.0, 1.0, True),
        (1.0, 1.25, True),
        (1.0, 0.75, True),
        (1.0, 1.26, False),
        (1.0, math.nan, False),
        (None, 1.0, None),
    ],
)
def test_a_claim_holds_up_to_its_tolerance_where_the_paper_prints_a_number(paper, ours, within):
    assert Claim("a", paper, ours, "m", tolerance=0.25).within is within


def test_a_number_that_does_not_exist_is_null_in_json():
    shown = Claim("a", 1.0, math.nan, "m").to_display()
    assert shown["ours"] is None and shown["within"] is False
    json.dumps(shown, allow_nan=False)


@pytest.fixture(params=["quick", pytest.param("whole", marks=pytest.mark.nightly)])
def output(request):
    return request.getfixturevalue(request.param)


def test_json_holds_claims_and_figures_and_a_number_that_disagrees_is_no_failure(output):
    assert output.exit_code == 0 and set(output.printed) == {"claims", "figures"}
    assert {claim["within"] for claim in output.printed["claims"]} == {True, False, None}
    for claim in output.printed["claims"]:
        assert {"name", "paper", "ours", "unit", "within", "note"} <= set(claim) and claim["note"]
        assert (claim["paper"] is None) == (claim["within"] is None)
    json.dumps(output.printed, allow_nan=False)


def test_every_figure_is_a_picture_with_something_in_it(output):
    assert len(output.printed["figures"]) == len(output.figures) >= 6
    for name in output.printed["figures"]:
        picture = output.folder / name.rsplit("/", 1)[-1]
        assert picture.read_bytes().startswith(b"\x89PNG")
        # An empty sheet of this size is below 20 kB.
        assert picture.stat().st_size > 50_000


def test_a_folder_that_cannot_be_made_is_named(tmp_path, capsys):
    (tmp_path / "taken").write_text("a file")
    assert main(["reproduce", "-o", str(tmp_path / "taken")]) == 2
    assert "taken" in capsys.readouterr().err


def test_what_does_not_agree_is_said_with_its_reason(monkeypatch, capsys, tmp_path):
    claims = (Claim("near", 1.0, 1.1, "µm", 0.2, "fine"), Claim("far", 1.0, 3.0, "µm", 0.2, "other plant"))
    monkeypatch.setattr(reproduce, "reproduce", lambda *arguments: Reproduction(claims, ()))
    assert main(["reproduce", "-o", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "not within tolerance: far: other plant" in text and "not within tolerance: near" not in text


PAGE = (Path(__file__).resolve().parents[3] / "docs" / "paper.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
    for line in PAGE.partition("## The numbers")[2].partition("\n## ")[0].splitlines()
    if line.startswith("| ") and not line.startswith("| claim")
]


def numbers(cell: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?[\d.]+", cell.replace("−", "-"))]


def of_the_same_row(claims: list[dict], name: str) -> list[dict]:
    """Claims under one heading of the page, which gathers our laws in one row."""
    ours = "each of our laws" in name
    figure = re.match(r"(beyond )?Fig. \d", name)
    found = [one for one in claims if figure is None or one["name"].startswith(figure[0])]
    if ours:
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
    claims = of_the_same_row(request.getfixturevalue(computed).printed["claims"], name)
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
    on_page = [float(number) for number in re.findall(r"[\d.]+", _cell(name))]
    slope, feedforward = CASES[name]
    found = fit.Stroke().errors(fit.plant_with(0.43), fit.law(slope, feedforward=feedforward))
    assert found.median == pytest.approx(on_page[0], abs=0.03)
    assert on_page[1] - 0.05 < found.min <= found.max < on_page[2] + 0.05


def test_the_fitted_friction_is_the_shipped_one():
    (coulomb, static) = re.search(r"F_C = ([\d.]+) N, F_S = ([\d.]+) N, literal", PAGE).groups()
    stage = shipped_parameters()["stage"]
    assert stage["friction.coulomb"] == float(coulomb)
    assert stage["friction.static"] == float(static)


@pytest.mark.nightly
@pytest.mark.parametrize("delay, bandwidth", [(0.5, 500.0), (1.0, 200.0)])
def test_the_steepest_stable_boundary_layer_is_that_of_the_page(delay, bandwidth, fit):
    line = next(line for line in PAGE.splitlines() if line.startswith(f"| {delay:g} | {bandwidth:g} |"))
    on_page = float(re.findall(r"(\d+) /s", line)[-1])
    assert math.isclose(fit.stable_slope(delay, bandwidth), on_page, abs_tol=15.0)


def _cell(name: str) -> str:
    return next(line for line in PAGE.splitlines() if line.startswith(f"| {name} |")).split("|")[3]
