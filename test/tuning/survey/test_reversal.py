"""Straightedge reversal gives the guide and the edge apart, and the uncertainty of both."""

import json

import numpy as np
import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.straightness.survey import Run, Survey, SurveyError, read_survey, write_survey
from straightcomp_ros.tuning.survey.reversal import separated

X = np.linspace(0.0, 1.0, 51)
GUIDE, EDGE = 1e-6 * np.sin(9.0 * X), 10e-6 * np.cos(14.0 * X)
WAYS = ("forward", "backward") * 3


def centred(curve):
    return curve - np.polyval(np.polyfit(X, curve, 1), X)


def surveys(random, noise, ways=WAYS):
    """A survey with the straightedge as it was, and one with it turned over and aligned anew."""
    lines = (GUIDE + EDGE, EDGE - GUIDE + 30e-6 * X - 5e-6)
    runs = (
        [Run(str(k), way, X, line + random.normal(0.0, noise, X.size)) for k, way in enumerate(ways)] for line in lines
    )
    return [Survey(tuple(one)) for one in runs]


def test_a_guide_of_a_tenth_of_the_straightedge_s_error_comes_out_with_its_sign_and_the_edge_with_its_own():
    found = separated(*surveys(np.random.default_rng(0), 0.0))
    assert found.guide_mean == pytest.approx(centred(GUIDE), abs=1e-12)
    assert found.edge_mean == pytest.approx(centred(EDGE), abs=1e-12)
    assert [run.direction for run in found.guide.runs] == ["forward"] * 3 + ["backward"] * 3 and found.left_out == 0


@pytest.mark.parametrize("draws", [100, pytest.param(1000, marks=pytest.mark.nightly)])
def test_the_standard_uncertainty_of_guide_and_edge_holds_95_percent_of_the_truth(draws):
    random, held = np.random.default_rng(1), []
    for _ in range(draws):
        found = separated(*surveys(random, 0.2e-6))
        for mean, truth in ((found.guide_mean, GUIDE), (found.edge_mean, EDGE)):
            held.append(np.abs(mean - centred(truth)) <= 1.96 * found.noise)
    assert 0.93 <= np.mean(held) <= 0.97
    # Six pairs of runs: √(s² + s²) / 2 / √6.
    assert found.noise == pytest.approx(0.2e-6 / np.sqrt(2.0) / np.sqrt(6.0), rel=0.15)


def test_runs_without_a_partner_are_left_out_and_without_any_pair_the_surveys_are_refused():
    normal, turned = surveys(np.random.default_rng(2), 0.0, ("forward", "forward", "backward"))
    forward = Survey(turned.runs[:1])
    found = separated(normal, forward)
    assert (len(found.guide.runs), found.left_out, found.noise) == (1, 2, None)
    with pytest.raises(SurveyError, match="no run in a direction"):
        separated(Survey(normal.runs[2:]), forward)


def test_the_verb_writes_both_as_surveys_and_prints_their_straightness(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, survey in zip(("m1.csv", "m2.csv"), surveys(np.random.default_rng(3), 0.0), strict=True):
        write_survey(name, survey)
    assert main(["map", "reverse", "m1.csv", "m2.csv", "-o", "guide.csv", "--edge", "edge.csv", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    for name, curve in (("guide", GUIDE), ("edge", EDGE)):
        assert figures[f"{name}_least_squares_um"] == pytest.approx(np.ptp(centred(curve)) * 1e6, abs=2e-3)
        assert read_survey(f"{name}.csv").runs[0].deviation == pytest.approx(centred(curve), abs=2e-9)
    assert (figures["pairs"], figures["left_out_runs"]) == (6, 0)
    assert main(["map", "reverse", "m1.csv", "m2.csv", "-o", "m1.csv", "--force"]) == 2
