import importlib
import json

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.tuning.paper.all_figures import FIGURES, Reproduction
from straightcomp_ros.tuning.paper.figure import Claim

# The package re-exports nothing; the module is patched, not the name.
command = importlib.import_module("straightcomp_ros.tuning.verbs.reproduce")


def test_the_report_is_no_failure_although_not_all_agrees(output):
    assert output.exit_code == 0
    assert {claim["within"] for claim in output.printed["claims"]} == {True, False, None}


def test_json_holds_claims_and_figures_and_nothing_else(output):
    assert set(output.printed) == {"claims", "figures"}
    for claim in output.printed["claims"]:
        assert {"name", "paper", "ours", "unit", "within", "note"} <= set(claim)
        assert (claim["paper"] is None) == (claim["within"] is None)
        assert claim["note"]
    json.dumps(output.printed, allow_nan=False)


def test_every_figure_is_a_picture_with_something_in_it(output):
    assert len(output.printed["figures"]) == len(FIGURES)
    for name in output.printed["figures"]:
        picture = output.folder / name.rsplit("/", 1)[-1]
        assert picture.read_bytes().startswith(b"\x89PNG")
        # An empty sheet of this size is below 20 kB.
        assert picture.stat().st_size > 50_000


def test_every_figure_has_a_claim(output):
    names = " ".join(claim["name"] for claim in output.printed["claims"])
    assert all(f"Fig. {number}" in names for number in range(2, 10))


def test_the_papers_poles_and_limit_are_met(output):
    judged = [claim for claim in output.printed["claims"] if "pole" in claim["name"] or "|m_i|" in claim["name"]]
    assert len(judged) == 4
    assert all(claim["within"] for claim in judged)


def test_a_folder_that_cannot_be_made_is_named(tmp_path, capsys):
    (tmp_path / "taken").write_text("a file")
    assert main(["reproduce", "-o", str(tmp_path / "taken")]) == 2
    assert "taken" in capsys.readouterr().err


@pytest.fixture
def two_claims(monkeypatch):
    claims = (Claim("near", 1.0, 1.1, "µm", 0.2, "fine"), Claim("far", 1.0, 3.0, "µm", 0.2, "other plant"))
    monkeypatch.setattr(command, "reproduce", lambda *arguments: Reproduction(claims, ()))


def test_what_does_not_agree_is_said_with_its_reason(two_claims, capsys, tmp_path):
    assert main(["reproduce", "-o", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "not within tolerance: far: other plant" in text
    assert "not within tolerance: near" not in text
