"""Alignment finds zero, scale, sign and tilt of a survey from three strokes, and how well it knows them; a check of a
map by another survey finds another guide."""

from dataclasses import replace

import numpy as np
import pytest
from surveys import one_run

from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.survey import Run, Survey, read_survey, write_survey
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.tuning.survey.alignment import align
from straightcomp_ros.tuning.survey.survey_check import survey_check

U = np.linspace(0.0, 1.76, 177)
MIDDLE, REACH, TILT, LAG = 0.88, 20e-3, 5e-6, 0.2e-3
GUIDE = load_map().deviations
SENSOR = 0.05e-6


def surveyed(random, noise=0.0, shift=0.0, scale=0.0, sign=1, guide=GUIDE, runs=6):
    """A survey of ``guide`` whose own x lies in the machine by ``shift`` and ``scale``."""
    true = sign * guide(U + shift + scale * (U - MIDDLE))
    ways = ("forward", "backward") * 3
    return Survey(tuple(Run(str(k), ways[k], U, true + random.normal(0.0, noise, U.size)) for k in range(runs)))


def stroked(random, guide=GUIDE, a_mm=6, span=(0.0, 1.76)):
    """Forward, backward and forward at 0.3 m/s: of the readings ``a_mm`` make a point every millimetre."""
    strokes = []
    for name, way in enumerate((1.0, -1.0, 1.0)):
        x = np.arange(*span, 1e-3) + random.uniform(0.0, 1e-3)
        line = TILT * (x - MIDDLE) + random.normal(0.0, 1e-6)
        noise = random.normal(0.0, SENSOR / np.sqrt(a_mm), x.size)
        strokes.append(Run(str(name), "forward" if way > 0 else "backward", x, guide(x - LAG * way) + line + noise))
    return strokes


def aligned(survey, strokes, reach=REACH):
    return align(StraightnessMap(survey, MapParameters(travel=0.01)), strokes, reach)


@pytest.mark.parametrize("sign", [1, -1])
def test_three_strokes_find_a_shift_of_1_mm_within_a_tenth_a_scale_of_1e_4_within_2e_5_and_the_sign(sign):
    random = np.random.default_rng(0)
    survey = surveyed(random, shift=1e-3, scale=1e-4, sign=sign)
    found = aligned(survey, stroked(random))
    assert found.found and found.sign == sign
    assert found.shift.value == pytest.approx(1e-3, abs=0.1e-3)
    assert found.scale.value == pytest.approx(1e-4, abs=2e-5)
    corrected = StraightnessMap(found.applied(survey), MapParameters(smooth="none"))
    x = np.linspace(0.01, 1.75, 500)
    assert corrected.deviations(x) == pytest.approx(GUIDE(x), abs=4e-9)
    tilted = found.applied(survey, tilt=True).runs[0].deviation - found.applied(survey).runs[0].deviation
    assert np.ptp(tilted) == pytest.approx(TILT * 1.76, rel=1e-3)


@pytest.mark.parametrize("draws", [15, pytest.param(1000, marks=pytest.mark.nightly)])
def test_three_strokes_at_0_1_m_per_s_find_every_scale_within_2e_5_and_as_well_as_their_readings_allow(draws):
    errors = []
    for seed in range(draws):
        random = np.random.default_rng(seed)
        found = aligned(surveyed(random, shift=1e-3, scale=1e-4), stroked(random, a_mm=20))
        errors.append(found.scale.value - 1e-4)
        # By Cramér and Rao: white noise of each reading, with shift, gain, tilt and a zero of each stroke not known.
        assert found.scale.uncertainty == pytest.approx(6.4e-6, rel=0.1)
    assert np.mean(np.abs(errors) <= 2e-5) >= 0.99


@pytest.mark.parametrize("draws", [40, pytest.param(1000, marks=pytest.mark.nightly)])
def test_each_interval_holds_the_truth_in_95_percent_of_draws_and_the_sign_is_never_wrong(draws):
    held = []
    for seed in range(draws):
        random = np.random.default_rng(seed)
        shift, scale, sign = random.uniform(-5e-3, 5e-3), random.uniform(-3e-4, 3e-4), random.choice([-1, 1])
        found = aligned(surveyed(random, 2e-8, shift, scale, sign), stroked(random))
        assert found.found and found.sign == sign
        true = (shift, scale, sign, TILT, LAG)
        held.append([abs(e.value - v) <= e.half_width for e, v in zip(found[1:6], true, strict=True)])
    few = 0.93 - 1.0 / np.sqrt(draws) * (draws < 1000)
    assert np.all(np.mean(held, axis=0) >= few)
    assert np.all(np.mean(held, axis=0) <= 0.97) or draws < 1000


def test_a_guide_that_is_too_flat_or_the_same_again_and_again_tells_nothing():
    random = np.random.default_rng(3)
    flat = [replace(run, deviation=random.normal(0.0, SENSOR, run.x.size)) for run in stroked(random)]
    assert not aligned(surveyed(random, 2e-8, guide=lambda x: 0.01 * GUIDE(x)), flat).found

    def wave(x):
        return 1e-6 * np.sin(2.0 * np.pi * x / 0.03)

    found = aligned(surveyed(random, 1e-8, guide=wave), stroked(random, wave))
    # Half a wave further the other sign fits.
    halves = (found.ambiguous - found.shift.value) / 0.015
    assert halves == pytest.approx(round(halves), abs=0.05) and round(halves) and not found.found


def test_a_shift_beyond_the_reach_and_strokes_over_less_than_half_of_the_survey_are_refused():
    random = np.random.default_rng(4)
    with pytest.raises(SurveyError, match="beyond a shift of 2 mm"):
        aligned(surveyed(random, shift=3e-3), stroked(random), 2e-3)
    with pytest.raises(SurveyError, match="less than half"):
        aligned(surveyed(random), stroked(random, span=(0.2, 1.0)))


def test_what_the_guide_has_become_since_the_survey_widens_the_intervals():
    def worn(x):
        return GUIDE(x) + 0.3e-6 * np.sin(2.0 * np.pi * x / 0.4)

    random = np.random.default_rng(5)
    survey = surveyed(random, 1e-8)
    sound, changed = (aligned(survey, stroked(random, guide)) for guide in (GUIDE, worn))
    assert (sound.changed, changed.changed) == (False, True)
    assert changed.shift.uncertainty > 5.0 * sound.shift.uncertainty
    assert abs(changed.shift.value) < changed.shift.half_width


def test_the_verb_writes_the_corrected_survey_only_when_asked(tmp_path, monkeypatch, verb):
    monkeypatch.chdir(tmp_path)
    random = np.random.default_rng(6)
    survey = surveyed(random, 1e-8, shift=1e-3, sign=-1)
    write_survey("survey.csv", survey, ["encoder reference: index 3", "instrument: probe 7"])
    write_survey("strokes.csv", Survey(tuple(stroked(random))))
    align_it = ["map", "align", "survey.csv", "strokes.csv"]
    figures = verb(*align_it, "--json").json
    assert (figures["sign"], figures["output"]) == (-1, None) and len(list(tmp_path.iterdir())) == 2
    assert figures["shift_mm"] == pytest.approx(1.0, abs=figures["shift_mm_95"])
    code, out, _ = verb(*align_it, "-o", "new.csv", "--note", "encoder reference=index 4")
    table = [[cell.strip() for cell in row.split("│")] for row in out.splitlines()]
    units = {row[1]: row[3] for row in table if len(row) == 5}
    assert code == 0 and units["shift"] == units["shift, ± (95 %)"] == "mm"
    assert units["lag, half of the shift between the directions"] == "mm"
    assert units["scale, ± (95 %)"] == "1e-6" and units["tilt, ± (95 %)"] == "µm/m"
    assert not any("told" in words or ("95 " not in words and "95" in words) for words in units)
    written = read_survey("new.csv")
    assert written.mark == "index 4" and written.facts["instrument"] == "probe 7"
    assert "straightcomp map align" in written.facts["aligned by"]
    # A survey that fits is written as it is: a former file of this name would be taken for it.
    (tmp_path / "again.csv").write_text("former")
    code, _, said = verb("map", "align", "new.csv", "strokes.csv", "-o", "again.csv", "--force")
    assert code == 0 and "nothing to correct" in said and "again.csv" in said
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "new.csv").read_bytes()
    # What is left with the map as it is, as a sensor on the workpiece sees it.
    before = StraightnessMap(survey, MapParameters())
    left = [replace(run, deviation=run.deviation - before.deviations(run.x)) for run in stroked(random)]
    write_survey("left.csv", Survey(tuple(left)))
    residual = verb("map", "align", "survey.csv", "left.csv", "--residual", "--json").json
    assert residual["shift_mm"] == pytest.approx(1.0, abs=0.1)


NOISE = 0.02e-6
SHIPPED = load_map()


def measured(guide, seed, *, runs=2, noise=0.1e-6, scale=1.0):
    """``guide`` at some places, plus a line of its own."""
    random = np.random.default_rng(seed)
    x = np.linspace(guide.span[0] + 0.01, guide.span[1] - 0.01, 12)
    line = 3e-6 + 5e-6 * x
    found = [scale * guide.deviations(x) + line + noise * random.standard_normal(x.size) for _ in range(runs)]
    directions = ("forward", "backward")
    return Survey(tuple(Run(str(k), directions[k % 2], x, one) for k, one in enumerate(found)), "check.csv")


def test_the_right_map_passes_whatever_the_uncertainty_of_the_check():
    for noise in (1e-9, 0.1e-6, 1e-6):
        assert all(survey_check(SHIPPED, measured(SHIPPED, seed, noise=noise), NOISE).agrees for seed in range(40))


@pytest.mark.parametrize("scale", [0.0, 0.5, 2.0, -1.0], ids=["straight", "half", "twice", "opposite"])
def test_a_map_of_another_guide_is_found(scale):
    for seed in range(20):
        found = survey_check(SHIPPED, measured(SHIPPED, seed, scale=scale), NOISE)
        assert not found.agrees and found.opposite is (scale < 0.0)
        assert found.difference > 3.0 * found.allowed


def test_another_zero_of_x_is_found_and_a_check_too_coarse_to_tell_says_how_coarse_it_is():
    x = np.linspace(*SHIPPED.span, 200)
    other = StraightnessMap(one_run(x + 0.1, SHIPPED.deviations(x)), MapParameters())
    assert not survey_check(other, measured(SHIPPED, 1), NOISE).agrees
    coarse = survey_check(SHIPPED, measured(SHIPPED, 1, noise=10e-6), NOISE)
    assert coarse.agrees and coarse.allowed > coarse.guide


def test_a_single_run_and_a_check_outside_of_the_map_are_refused():
    with pytest.raises(SurveyError, match=r"check survey check.csv: has one run; allowed: >= 2"):
        survey_check(SHIPPED, measured(SHIPPED, 1, runs=1), NOISE)
    far = measured(SHIPPED, 1)
    moved = Survey(tuple(Run(run.name, run.direction, run.x + 1.2, run.deviation) for run in far.runs), "check.csv")
    with pytest.raises(SurveyError, match=r"check survey check.csv: \d points between 0 mm and .*where the map is"):
        survey_check(SHIPPED, moved, NOISE)
