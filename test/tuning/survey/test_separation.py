"""Reversal and shift give the guide and the straightedge apart, and the uncertainty of both."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiers import nightly

from straightcomp_ros.straightness.survey import Run, Survey, read_survey, write_survey
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.tuning.survey.separation import separated

X = np.linspace(0.0, 1.0, 51)


def cosine(x):
    """The straightedge of which all crests are equally high: what errors do to its straightness is the most."""
    return 10e-6 * np.cos(14.0 * x)


GUIDE, EDGE = 1e-6 * np.sin(9.0 * X), cosine(X)
WAYS = ("forward", "backward") * 3


def centred(curve):
    return curve - np.polyval(np.polyfit(X, curve, 1), X)


def noisy(random, noise, lines, ways=WAYS):
    """A survey of each of the ``lines``, with a run for each of the ``ways``."""
    runs = ([Run(str(k), w, X, line + random.normal(0.0, noise, X.size)) for k, w in enumerate(ways)] for line in lines)
    return [Survey(tuple(one)) for one in runs]


def surveys(random, noise, ways=WAYS, guide=GUIDE, edge=EDGE):
    """A survey with the straightedge as it was, and one with it turned over and aligned anew."""
    return noisy(random, noise, (guide + edge, edge - guide + 30e-6 * X - 5e-6), ways)


def test_a_guide_of_a_tenth_of_the_straightedge_s_error_comes_out_with_its_sign_and_the_edge_with_its_own():
    found = separated(*surveys(np.random.default_rng(0), 0.0))
    assert found.guide.mean == pytest.approx(centred(GUIDE), abs=1e-12)
    assert found.edge.mean == pytest.approx(centred(EDGE), abs=1e-12)
    assert [run.direction for run in found.guide.survey.runs] == [*["forward"] * 3, *["backward"] * 3]
    assert found.left_out == 0


def shifted(random, noise, shift, moved, guide=GUIDE, edge=cosine):
    """A survey as it was, and one with the straightedge moved and aligned anew, or with the sensor moved."""
    other = edge(X + (shift if moved == "sensor" else -shift)) + guide - 2e-6
    other = other + (30e-6 * X if moved == "straightedge" else 0.0)
    return noisy(random, noise, (guide + edge(X), other))


def drawn_shape(random, pp):
    """A guide's or straightedge's deviation over x, ``pp`` in m p-p: six waves, whose curvature is alike."""
    waves = np.arange(1, 7)
    heights, phases = random.normal(size=6) / waves**2, random.uniform(0.0, 2.0 * np.pi, 6)

    def unscaled(x):
        return np.sin(np.pi * np.outer(x, waves) + phases) @ heights

    return lambda x: pp / np.ptp(unscaled(X)) * unscaled(x)


def apart(seed, noise, moved, drawn):
    """Guide and edge, of ``drawn`` shapes or not, from surveys with this noise, by reversal or by a shift of 60 mm."""
    random = np.random.default_rng(seed)
    guide, edge = (drawn_shape(random, 2e-6)(X), drawn_shape(random, 20e-6)) if drawn else (GUIDE, cosine)
    if moved:
        return separated(*shifted(random, noise, 0.06, moved, guide, edge), 0.06, moved)
    return separated(*surveys(random, noise, guide=guide, edge=edge(X)))


@pytest.mark.parametrize(("draws", "drawn"), [(30, True), *nightly([(1000, True), (1000, False)])])
@pytest.mark.parametrize("moved", [None, "straightedge", *nightly(["sensor"])])
def test_the_uncertainties_of_guide_and_edge_hold_95_percent_of_what_surveys_without_noise_give(moved, draws, drawn):
    points, lines = [], []
    for seed in range(draws):
        found, exact = apart(seed, 0.2e-6, moved, drawn), apart(seed, 0.0, moved, drawn)
        points.append(np.abs(found.guide.mean - exact.guide.mean) <= 1.96 * found.guide.s)
        points.append(np.abs(found.edge.mean - exact.edge.mean) <= 1.96 * found.edge.s)
        pairs = zip(found.guide.lines + found.edge.lines, exact.guide.lines + exact.edge.lines, strict=True)
        lines.append([abs(one.value - true.value) <= one.expanded_uncertainty for one, true in pairs])
    assert 0.93 <= np.mean(points) <= 0.97
    wrong = 0.135 if draws < 1000 else 0.05 if moved and not drawn else 0.02
    assert np.mean(lines, axis=0) == pytest.approx(0.95, abs=wrong + 1e-9)
    if moved is None:
        # Six pairs of runs: √(s² + s²) / 2 / √6.
        assert found.guide.s[1:-1] == pytest.approx(0.2e-6 / np.sqrt(2.0) / np.sqrt(6.0), rel=0.15)


def test_a_straightedge_that_tilts_between_the_runs_makes_the_parabola_of_a_moved_sensor_as_uncertain():
    random, held = np.random.default_rng(0), []
    for _ in range(30):
        tilted = [
            Survey(tuple(replace(run, deviation=run.deviation + random.normal(0.0, 1e-6) * X) for run in survey.runs))
            for survey in shifted(random, 0.05e-6, 0.06, "sensor")
        ]
        found = separated(*tilted, 0.06, "sensor")
        held.append(np.abs(found.guide.mean - centred(GUIDE)) <= 1.96 * found.guide.s)
    assert 0.85 <= np.mean(held) <= 0.99


def test_runs_without_a_partner_are_left_out_and_without_any_pair_the_surveys_are_refused():
    normal, turned = surveys(np.random.default_rng(2), 0.0, ("forward", "forward", "backward"))
    forward = Survey(turned.runs[:1])
    found = separated(normal, forward)
    assert (len(found.guide.survey.runs), found.left_out, found.guide.s) == (1, 2, None)
    with pytest.raises(SurveyError, match="no run in a direction"):
        separated(Survey(normal.runs[2:]), forward)


@pytest.mark.parametrize("shift", [0.02, 0.05, -0.07, 0.1])
@pytest.mark.parametrize("moved", ["straightedge", "sensor"])
def test_a_shift_separates_a_smooth_straightedge_of_ten_times_the_guide_but_for_the_parabola_if_moved(shift, moved):
    found = separated(*shifted(np.random.default_rng(0), 0.0, shift, moved), shift, moved)
    powers = 1 if moved == "sensor" else 2
    for mean, truth in ((found.guide.mean, GUIDE), (found.edge.mean, EDGE)):
        apart = mean - truth
        assert apart - np.polyval(np.polyfit(X, apart, powers), X) == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize("points", [4000, *nightly([20_000])])
def test_reversal_takes_thousands_of_points_and_a_shift_refuses_more_than_it_can_solve_for(points):
    x = np.linspace(0.0, 1.0, points)
    guide, edge = 1e-6 * np.sin(9.0 * x), cosine(x)
    normal, turned = (
        Survey(tuple(Run(str(k), "forward", x, line + 1e-7 * (-1) ** k) for k in range(2)))
        for line in (guide + edge, edge - guide)
    )
    found = separated(normal, turned)
    assert found.guide.mean == pytest.approx(guide - np.polyval(np.polyfit(x, guide, 1), x), abs=1e-12)
    with pytest.raises(SurveyError, match=f"{points} points"):
        separated(normal, turned, 0.05)


@pytest.mark.parametrize("moved", ["straightedge", "sensor"])
def test_waves_of_the_straightedge_as_long_as_the_shift_stay_in_the_guide(moved):
    wave = 1e-6 * np.sin(2.0 * np.pi * X / 0.1)
    normal, second = shifted(np.random.default_rng(0), 0.0, 0.1, moved)
    waves = [Survey(tuple(Run(r.name, r.direction, X, r.deviation + wave) for r in s.runs)) for s in (normal, second)]
    with_waves, without = separated(*waves, 0.1, moved), separated(normal, second, 0.1, moved)
    assert with_waves.guide.mean - without.guide.mean == pytest.approx(centred(wave), abs=2e-8)
    for shift in (0.01, 0.11):
        with pytest.raises(SurveyError, match="20 mm, to a tenth of their length, 100 mm"):
            separated(normal, second, shift, moved)


def test_the_verb_writes_both_as_surveys_and_prints_their_straightness(tmp_path, monkeypatch, verb):
    monkeypatch.chdir(tmp_path)
    for name, survey in zip(("m1.csv", "m2.csv"), surveys(np.random.default_rng(3), 0.0), strict=True):
        write_survey(name, survey)
    reverse = ["map", "reverse", "m1.csv", "m2.csv", "-o"]
    figures = verb(*reverse, "guide.csv", "--edge", "edge.csv", "--json").json
    for name, curve in (("guide", GUIDE), ("edge", EDGE)):
        assert figures[f"{name}_least_squares_um"] == pytest.approx(np.ptp(centred(curve)) * 1e6, abs=2e-3)
        assert read_survey(f"{name}.csv").runs[0].deviation == pytest.approx(centred(curve), abs=2e-9)
    assert (figures["pairs"], figures["left_out_runs"]) == (6, 0)
    assert verb(*reverse, "m1.csv", "--force").code == 2
    # Neither of two results is lost where both are given one name.
    Path("link.csv").symlink_to("both.csv")
    assert verb(*reverse, "both.csv", "--edge", "link.csv").code == 2 and not Path("both.csv").exists()
    for name, survey in zip(("m1.csv", "m2.csv"), shifted(np.random.default_rng(3), 0.0, 0.05, "sensor"), strict=True):
        write_survey(name, survey, ["encoder reference: index 3"])
    code, _, said = verb(*reverse, "g.csv", "--shift", 50, "--moved", "sensor")
    guide = read_survey("g.csv")
    assert guide.mark == "index 3" and guide.runs[0].deviation == pytest.approx(centred(GUIDE), abs=4e-9)
    assert code == 0 and "waves of 50 mm" in said
