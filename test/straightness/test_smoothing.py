"""The map and the noise of its survey: found between runs, taken off where it hides the guide, stated as a band."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.linalg import eigvalsh
from scipy.stats import norm
from tiers import nightly

from straightcomp_ros.model.motion import MotionParameters
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.smoothing import NORMAL_95, measured, point_noise
from straightcomp_ros.straightness.survey import Run, Survey, read_survey
from straightcomp_ros.straightness.survey_runs import on_common_grid
from straightcomp_ros.tuning.identification.estimate import excitation
from trials.noise import FINE, GUIDE, JOINT, KINK, WAYS, Kind, errors, guide, kinds, mapped, surveyed

LACKING = range(300, 316)
TABLE = [("shipped", *each) for each in itertools.product((0.5, 1.0, 2.0, 10.0, 20.0), (0.05, 0.2, 0.5))]
TABLE += [("shipped", 5.0, 0.05), ("shipped", 5.0, 0.5), ("ground, 2 um", 0.5, 0.5)]


@pytest.mark.parametrize("runs", [1, 2])
def test_without_repeated_runs_the_noise_is_that_of_the_residual_and_the_map_says_so(runs):
    for how in ("auto", "1"):
        noise = mapped(surveyed(1e-3, 2e-7, runs=runs), how).noise
        assert noise.point == pytest.approx(2e-7 / np.sqrt(runs), rel=0.1)
        assert not noise.repeated and "no run was repeated" in str(noise)
        assert noise.smoothed


def test_of_a_run_that_was_not_repeated_only_what_bends_the_reference_more_than_twice_as_much_is_taken_off():
    for spacing, noise in ((1e-3, 2e-8), (1e-3, 5e-7), (2e-3, 2e-7), (10e-3, 2e-8), (10e-3, 5e-7), (20e-3, 2e-8)):
        through, found = (mapped(surveyed(spacing, noise, runs=1), how) for how in ("none", "auto"))
        bends = [np.abs(one.evaluate(FINE)[2]).max() for one in (through, found)]
        assert (
            found.noise.smoothed == (bends[0] > 2.0 * bends[1])
            and bends[1] < 2.0 * np.abs(GUIDE.evaluate(FINE)[2]).max()
        )
    half_a_metre = StageParameters(motion=MotionParameters(stroke=0.5))
    assert not StraightnessMap(excitation(half_a_metre).survey, MapParameters(travel=0.01)).noise.smoothed


@pytest.mark.parametrize("file", ["config/guide_synthetic.csv", "config/survey_synthetic.csv"])
def test_a_clean_survey_is_interpolated_to_the_last_bit(file):
    straightness = load_map(MapParameters(file))
    assert not straightness.noise.smoothed
    for how in ("none", "0"):
        plain = load_map(MapParameters(file, smooth=how))
        np.testing.assert_array_equal(straightness.evaluate(FINE), plain.evaluate(FINE))
    survey = read_survey(file)
    x, values = on_common_grid(survey, 20, 0.05)
    np.testing.assert_allclose(straightness.deviations(x), values.mean(axis=0), atol=1e-15)


@pytest.mark.parametrize(
    ("spacing", "noise"), [(0.2e-3, 5e-8), (1e-3, 2e-7), (5e-3, 5e-7), (10e-3, 5e-8), (10e-3, 5e-7), (20e-3, 5e-7)]
)
def test_no_noise_makes_the_reference_curve_more_than_twice_as_much_as_the_guide_or_run_away_beyond_its_ends(
    spacing, noise
):
    straightness = mapped(surveyed(spacing, noise))
    for x, order, factor in ((FINE, 2, 2.0), ([-0.02, 1.78], 0, 1.5)):
        found, true = (np.abs(one.evaluate(x)[order]).max() for one in (straightness, GUIDE))
        assert found < factor * true


@pytest.mark.parametrize("kind", ["shipped", "with a joint", "ground, 2 um", "3 m, hysteresis 0.3 um"])
def test_with_auto_no_table_curves_more_than_twice_as_much_as_the_smooth_curve_of_the_survey(kind):
    guide_of, through, tables = kinds()[kind], [], set()
    for spacing, noise in ((5e-3, 5e-8), (10e-3, 2e-8), (10e-3, 2e-7), (15e-3, 5e-7)):
        survey = surveyed(spacing, noise, guide_of)
        maps = [mapped(survey, how) for how in ("none", "auto", "1")]
        tables |= {one.directed for one in maps}
        x = np.linspace(*guide_of.base.span, 20 * survey.runs[0].x.size)
        for way in WAYS:
            all_means, found, smooth = (np.abs(one.evaluate(x, way)[2]).max() for one in maps)
            assert found <= 2.0 * smooth
            through.append(all_means > 2.0 * smooth)
    assert any(through) and (True in tables) == (guide_of.hysteresis > 0.0)


def test_a_joint_stays_sharp_in_a_map_that_is_smooth_elsewhere():
    survey, near = surveyed(1e-3, 5e-8, Kind(kink=KINK)), np.abs(FINE - JOINT) < 0.01
    left, through = (mapped(survey, how).deviations(FINE) - guide(FINE, KINK) for how in ("auto", "none"))
    assert np.ptp(left[near]) < 0.1e-6
    # One amount of smoothing for all x that leaves as little noise elsewhere rounds the joint off by more.
    assert np.ptp(left[~near]) < 0.6 * np.ptp(through)


def test_a_guide_too_rough_for_the_knots_is_interpolated_and_a_step_keeps_the_noise_from_no_other_place():
    survey, random = surveyed(1e-3, 25e-9), np.random.default_rng(3)
    x = survey.runs[0].x
    rough = np.interp(x, np.linspace(*GUIDE.span, 400), 3e-7 * random.normal(size=400))
    stepped = np.where(x > JOINT, 5e-6, 0.0)
    for form, smoothed in ((rough, False), (stepped, True), (0.0 * x, True)):
        runs = tuple(replace(run, deviation=run.deviation + form) for run in survey.runs)
        assert mapped(Survey(runs)).noise.smoothed == smoothed


def test_a_factor_multiplies_the_smoothing():
    survey = surveyed(2e-3, 2e-7)
    bends = [np.abs(mapped(survey, how).evaluate(FINE)[2]).max() for how in ("none", "0.001", "1", "1000")]
    assert bends == sorted(bends, reverse=True) and bends[0] > 2.0 * bends[-1]
    np.testing.assert_array_equal(mapped(survey, "1").evaluate(FINE), mapped(survey).evaluate(FINE))
    # A factor is a wish: it smooths where auto leaves the survey as it is.
    assert mapped(read_survey("config/survey_synthetic.csv"), "1").noise.smoothed
    for wrong in ("some", "-1", "nan", "inf", ""):
        with pytest.raises(ParameterError, match=r"'smooth'.*allowed: auto, none or a number"):
            from_mapping(MapParameters, {"smooth": wrong})


def kept(run, which):
    return replace(run, x=run.x[which], deviation=run.deviation[which])


def test_spacing_may_be_unequal():
    survey = surveyed(1e-3, 2e-7)
    x = survey.runs[0].x
    here = (x < 0.5) | (x > 1.2) | (np.arange(x.size) % 10 == 0)
    sparse = (x > 0.52) & (x < 1.18)
    straightness = mapped(Survey(tuple(kept(run, here) for run in survey.runs)))
    off = straightness.deviations(x) - guide(x)
    assert np.ptp(off[~sparse]) < 0.25e-6 and np.ptp(off[sparse]) < 0.45e-6
    band = straightness.noise.band(x)
    assert np.median(band[sparse]) > 1.5 * np.median(band[~sparse])


def test_points_that_few_runs_have_weigh_less_and_are_less_certain():
    survey = surveyed(2e-3, 2e-7, drift=2e-6)
    x = survey.runs[0].x
    holed = Survey((survey.runs[0], *(kept(run, np.isin(x, x[LACKING], invert=True)) for run in survey.runs[1:])))
    assert np.flatnonzero(~measured(holed, x)).tolist() == [run * x.size + at for run in range(1, 6) for at in LACKING]
    straightness = mapped(holed)
    assert straightness.noise.band(x[308]) > 1.2 * straightness.noise.band(x[200])
    # Where one run measured, its own noise and drift are what the map has to go by.
    assert straightness.noise.point == pytest.approx(mapped(survey).noise.point, rel=0.05)
    assert np.ptp((straightness.deviations(x) - guide(x))[LACKING]) < 0.3e-6


def alone(deviations, x, ways):
    return Survey(tuple(Run("1", way, x, one) for way, one in zip(ways, deviations, strict=True)))


@pytest.mark.parametrize("counts", [(3, 3), (4, 2), (2, 1), (1, 5)])
def test_the_noise_of_a_point_is_what_least_squares_leave_of_a_value_at_each_point_and_a_line_of_each_run(counts):
    x, random = np.sort(np.random.default_rng(1).uniform(0.0, 0.7, 9)), np.random.default_rng(3)
    values, variances = [], []
    for count in counts:
        runs = random.normal(0.0, 1e-6, (count, x.size))
        lines = np.kron(np.eye(count), np.column_stack([np.ones_like(x), x]))
        model = np.hstack([np.tile(np.eye(x.size), (count, 1)), lines])
        left = runs.ravel() - model @ np.linalg.lstsq(model, runs.ravel(), rcond=None)[0]
        freedom = runs.size - np.linalg.matrix_rank(model)
        values += list(runs)
        variances.append(left @ left / freedom if freedom else None)
    known = [other if one is None else one for one, other in zip(variances, variances[::-1], strict=True)]
    expected = np.sqrt(sum(one / count for one, count in zip(known, counts, strict=True))) / 2.0
    survey = alone(values, x, np.repeat(WAYS, counts))
    assert point_noise(survey, x, np.array(values), measured(survey, x)) == pytest.approx(expected, rel=1e-9)


def test_a_point_is_measured_where_a_point_of_the_run_is_nearer_than_half_a_step():
    random, x = np.random.default_rng(5), np.linspace(0.1, 1.0, 91)
    runs = [np.unique(random.uniform(low, high, 91)) for low, high in ((0.0, 1.1), (0.2, 0.9), (0.12, 0.13))]
    found = measured(Survey(tuple(Run("1", "forward", run, 0.0 * run) for run in runs)), x)
    expected = [np.abs(run - x[:, None]).min(axis=1) <= 0.5 * (x[1] - x[0]) for run in runs]
    np.testing.assert_array_equal(found, expected)
    assert found[:2].any(axis=1).all() and not found.all(axis=1).any()


@pytest.mark.parametrize("how", ["1", "1000", "1e6"])
def test_of_a_parabola_with_little_noise_no_factor_makes_another_curve(how):
    x = np.linspace(0.3, 1.1, 81)
    values = 2e-5 * x**2 - 1e-5 * x + np.random.default_rng(6).normal(0.0, 1e-7, (6, x.size))
    found = mapped(alone(values, x, WAYS * 3), how).deviations(x)
    assert found == pytest.approx(np.polyval(np.polyfit(x, values.mean(axis=0), 2), x), abs=1e-7)


@pytest.mark.parametrize(("kink", "how", "factor"), [(0.0, "1", 1.0), (1e-4, "1", 1.0), (1e-4, "3", 3.0)])
def test_the_map_is_the_mean_of_penalised_fits_weighed_by_their_estimated_errors(kink, how, factor):
    x, random = np.linspace(0.0, 1.0, 60), np.random.default_rng(8)
    values = 2e-6 * np.sin(5.0 * x) + kink * np.abs(x - 0.6) + random.normal(0.0, 2e-7, (6, x.size))
    straightness = mapped(alone(values, x, WAYS * 3), how)
    mean, noise, knots = values.mean(axis=0), straightness.noise.point, np.delete(x, [1, -2])
    inner, middles, pieces = np.isin(x, knots), (knots[1:] + knots[:-1]) / 2.0, np.diff(knots)
    # The cubic splines by their values at the knots and their curvatures at the ends.
    natural = CubicSpline(knots, np.eye(knots.size), bc_type="natural")
    bent = CubicSpline(knots, np.zeros((knots.size, 2)), bc_type=((2, [1.0, 0.0]), (2, [0.0, 1.0])))
    at_points, third = (np.hstack([natural(at, k), bent(at, k)]) for at, k in ((x, 0), (middles, 3)))

    def hat(amounts, runs=1.0):
        penalty = third.T @ ((pieces * amounts)[:, None] * third)
        return at_points @ np.linalg.solve(at_points.T @ at_points + penalty / runs, at_points.T)

    stiffest = eigvalsh(third.T @ (pieces[:, None] * third), at_points.T @ at_points)[-1]
    choices = np.geomspace(1.0, 1e12, 25) / stiffest
    hats = np.array([hat(np.full(pieces.size, amount)) for amount in choices])
    fits, freedom = hats @ mean, np.trace(hats, axis1=1, axis2=2)
    shares = np.exp(-(np.sum((mean - fits) ** 2, axis=1) / noise**2 + 2.0 * freedom) / 4.0)
    shares = np.where(shares > 0.02 * shares.sum(), shares, 0.0) / shares.sum()
    used = np.flatnonzero(shares)
    # Lepski's rule, at the knots.
    detected, local, holds = norm.isf(0.025 / freedom[0]), np.zeros(knots.size, int), np.ones(knots.size, bool)
    for smoother in range(1, used[-1] + 1):
        spread = noise * np.linalg.norm(hats[smoother] - hats[:smoother], axis=2)
        holds &= np.all(np.abs(fits[smoother] - fits[:smoother]) <= detected * spread, axis=0)[inner]
        local[holds] = smoother
    assert local.min() < used[-1]
    amounts = [factor * np.exp(np.interp(middles, knots, np.log(choices[np.minimum(local, one)]))) for one in used]
    shares, once, twice = (
        shares[used] / shares[used].sum(),
        *(np.array([hat(one, runs) for one in amounts]) for runs in (1.0, 2.0)),
    )
    expected = shares @ (once @ mean)
    np.testing.assert_allclose(straightness.deviations(x), expected, atol=1e-11)
    between = shares @ (once @ mean - expected) ** 2
    variances = [
        shares @ np.diagonal(hats, axis1=1, axis2=2) * noise**2 / runs for hats, runs in ((once, 1.0), (twice, 2.0))
    ]
    np.testing.assert_allclose(straightness.noise.band(knots) ** 2, (variances[0] + between)[inner], rtol=1e-4)
    expected = np.mean((variances[1] + between / 2.0)[inner])
    assert straightness.noise.twice**2 == pytest.approx(expected, rel=1e-4, abs=0.0)


def test_more_runs_leave_less():
    noise = mapped(surveyed(1e-3, 2e-7)).noise
    doubled = mapped(surveyed(1e-3, 2e-7, runs=12)).noise
    assert NORMAL_95 * noise.twice == pytest.approx(doubled.half_width, rel=0.15)
    assert f"±{noise.half_width * 1e6:.2g} µm (95 %); 6 more runs" in str(noise)


@pytest.mark.parametrize(
    ("kind", "spacing", "noise"),
    [("shipped", 5.0, 0.2), *(pytest.param(*each, marks=pytest.mark.nightly) for each in TABLE)],
)
def test_the_error_is_within_1_2_of_what_the_best_smoothing_leaves_that_knows_the_guide(kind, spacing, noise):
    found = errors(kinds()[kind], spacing, noise)
    assert found["auto"] <= 1.2 * found["best"]


BANDS = [("shipped", 5e-3, 2e-7), ("shipped", 10e-3, 25e-9), ("ground, 2 um", 10e-3, 2e-7)]
BANDS += nightly([("shipped", 1e-3, 2e-7), ("ground, 2 um", 5e-3, 5e-7), ("shipped", 20e-3, 5e-7)])


@pytest.mark.parametrize("draws", [20, pytest.param(1000, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(("kind", "spacing", "noise"), BANDS)
def test_the_95_percent_band_contains_the_guide_at_95_percent_of_x(kind, spacing, noise, draws):
    base, held = kinds()[kind].base, []
    for seed in range(draws):
        survey = surveyed(spacing, noise, Kind(base), seed=seed)
        straightness, x = mapped(survey), survey.runs[0].x
        left = straightness.deviations(x) - base.deviations(x)
        held.append(np.mean(np.abs(left) <= NORMAL_95 * straightness.noise.band(x)))
    # Twenty maps of a short guide have some 200 places that are as good as independent: three standard deviations.
    assert np.mean(held) == pytest.approx(0.95, abs=0.02 if draws == 1000 else 0.045)
