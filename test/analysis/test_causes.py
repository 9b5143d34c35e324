"""What finds the cause of an error, compared with sums, loops and closed forms."""

import itertools
import math

import numpy as np
import pytest
from scipy.stats import rayleigh
from surveys import GUIDE, one_run

from straightcomp_ros.analysis import causes
from straightcomp_ros.analysis.causes import (
    Line,
    comes_and_goes,
    dragging,
    locked_to_x,
    mains,
    mode_of,
    of_error,
    of_map,
)
from straightcomp_ros.analysis.judged_motion import JudgedMotion
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap

T = 5e-4
TIME = np.arange(16_000) * T
THERE_AND_BACK = 1.0 - np.abs(TIME - 4.0) / 4.0
STILL = (TIME > 3.0) & (TIME < 3.5)
PAUSED = np.cumsum(np.where(STILL, 0.0, np.where(TIME < 3.5, 0.5, -0.5))) * T


@pytest.fixture
def random():
    return np.random.default_rng(1)


def motion(error, period=T, **changes) -> JudgedMotion:
    time = np.arange(error.size) * period
    fixed = {"time": time, "x": 0.2 * time, "r": 0.0 * time, "current": 0.0 * time, "count": 0.0}
    values = {**fixed, "error": error, **changes}
    return JudgedMotion(**{"y": values["r"] - error, **values})


def sine(frequency, period=T, size=16_000):
    return 0.3e-6 * np.sin(2.0 * np.pi * frequency * period * np.arange(size) + 1.0)


@pytest.mark.parametrize("begin", [-3.0, 2.0])
def test_a_wave_over_uneven_places_has_its_amplitude_and_length_whatever_goes_on_in_time(begin, random):
    along = begin + 0.85 * (1.0 - np.cos(0.25 * np.pi * TIME)) + 1e-5 * random.uniform(size=TIME.size)
    waves = 0.3e-6 * np.sin(2.0 * np.pi * 17.3 * along) + 0.5 * sine(60.0)
    found = locked_to_x(motion(waves, x=along, r=1e-5 * np.sin(TIME)))
    assert found == pytest.approx((0.3e-6, 17.3), rel=0.06)
    assert locked_to_x(motion(waves + 0.6 * sine(60.0), x=along, r=1e-5 * np.sin(TIME))) is None


@pytest.mark.parametrize("grid", [50.0, 60.0])
def test_each_line_of_a_grid_is_of_the_mains_within_the_grids_tolerance(grid):
    for multiple in range(1, 7):
        frequency = multiple * grid
        for off, is_mains in ((0.997, True), (1.003, True), (0.993, False), (1.007, False)):
            others = 2.0 * sine(0.7 * frequency) + 2.0 * sine(1.6 * frequency) + 1e-4
            found = mains(motion(sine(off * frequency) + others), Line(0.3e-6, frequency))
            assert (found is not None) == is_mains, (frequency, off)
            if found:
                assert found == pytest.approx((0.3e-6, off * frequency), rel=0.05)
    assert mains(motion(sine(7.0 * grid)), Line(0.3e-6, 7.0 * grid)) is None


@pytest.mark.parametrize(
    ("other", "amplitude", "is_mains"),
    [
        (100.0, 0.15, True),
        (100.0, 0.07, False),
        (150.0, 0.5, False),
        (200.0, 0.15, True),
        (30.0, 0.5, False),
    ],
)
def test_a_line_of_twelve_samples_is_of_the_mains_by_a_line_that_a_symmetric_limit_cycle_has_not(
    other, amplitude, is_mains, random
):
    noise = 1e-10 * random.standard_normal(16_000)
    error = sine(50.0, 1.0 / 600.0) + amplitude * sine(other, 1.0 / 600.0) + noise
    assert (mains(motion(error, 1.0 / 600.0), Line(0.3e-6, 50.0)) is not None) == is_mains


@pytest.mark.parametrize(("away", "is_mains"), [(-1.5, True), (-0.5, False), (0.5, False), (1.5, True)])
def test_a_line_that_the_length_resolves_from_whole_samples_is_no_limit_cycle(away, is_mains, random):
    error = sine(50.0 + away * 600.0 / 16_000, 1.0 / 600.0) + 1e-10 * random.standard_normal(16_000)
    assert (mains(motion(error, 1.0 / 600.0), Line(0.3e-6, 50.0)) is not None) == is_mains


def test_the_mains_are_in_each_rest_within_its_resolution_and_five_times_the_median_of_half_of_their_frequency(random):
    outcomes = []
    (rest,) = motion(TIME, x=PAUSED).resting()
    turns = np.arange(24.0, 76.0, 0.25 / (rest.size * T))
    off = np.abs(turns - 50.0) * rest.size * T
    transform = np.exp(-2j * np.pi * T * np.outer(turns, np.arange(rest.size)))
    for _ in range(200):
        away, near = random.uniform(-6.0, 6.0), random.uniform(20.0, 80.0)
        line, other = random.uniform(0.0, 0.8, 2) * random.integers(0, 2, 2)
        # More than half of the frequency away there is more of it.
        noise = 1e-5 + 6e-8 * np.convolve(random.standard_normal(TIME.size + 11), np.repeat([1, -1], 6), "valid")
        run = motion(np.where(STILL, line * sine(50.0 + away) + other * sine(near) + noise, sine(50.0)), x=PAUSED)
        (rest,) = run.resting()
        waves = np.abs(transform @ (rest - rest.mean()))
        around = np.median(waves[(off > 2.0) & (np.abs(turns / 50.0 - 1.0) < 0.5)])
        least, most = (waves[off <= at].max() / (5.0 * around) for at in (0.85, 1.15))
        if least > 1.05 or most < 0.95:
            outcomes.append(least > 1.0)
            assert (mains(run, Line(0.3e-6, 50.0)) is not None) == outcomes[-1]
    assert 20 < sum(outcomes) < 150


def test_a_line_is_of_the_nearest_mode_within_a_tenth():
    assert [mode_of(one, (200.0, 80.0)) for one in (73.0, 87.0, 185.0, 215.0)] == [80.0, 80.0, 200.0, 200.0]
    assert [mode_of(one, (200.0, 80.0)) for one in (70.0, 90.0, 140.0, 225.0)] == [None] * 4
    assert mode_of(80.0, ()) is None


def beating(depth, size=16_000):
    """A line whose amplitude goes evenly from 1 - depth to 1 + depth and back, a line beside it, and an offset."""
    slow = 4.0 * np.abs((np.arange(size) * T * 1.5) % 1.0 - 0.5) - 1.0
    return (1.0 + depth * slow) * sine(60.0, size=size) + 3.0 * sine(90.0, size=size) + 1e-6


def test_a_line_comes_and_goes_from_half_of_the_spread_of_noise_behind_a_resonance_on():
    low, middle, high = rayleigh.ppf([0.25, 0.5, 0.75])
    # Between the quartiles of an even distribution lies half of its range.
    half = 0.5 * (high - low) / middle
    found = [comes_and_goes([beating(share * half)], 60.0, T) for share in (0.0, 0.9, 1.1)]
    assert found == [False, False, True]
    # A line that wanders by a tenth does not come and go.
    wandering = 0.3e-6 * np.sin(2.0 * np.pi * np.cumsum(60.0 + 6.0 * np.sin(TIME)) * T)
    assert not comes_and_goes([wandering], 60.0, T)
    # Of several pieces the steadier half decides.
    none, little, much = beating(0.0), beating(0.9 * half), beating(2.0 * half)
    for pieces, expected in (
        ((much, none), False),
        ((much, none, much), False),
        ((much, beating(1.3 * half), little), True),
        ((much, much, little, none), False),
        ((much, much, much, beating(1.1 * half)), True),
        ((0.0 * none,), False),
        ((0.0 * none, beating(2.3 * half), beating(2.3 * half)), True),
    ):
        assert comes_and_goes(pieces, 60.0, T) == expected


def test_stick_slip_is_that_of_a_loop_over_velocities_of_two_milliseconds_or_a_sample(random):
    outcomes = set()
    for _ in range(2000):
        velocity = random.standard_t(2.0, 40) * (random.uniform(size=40) < random.uniform(0.2, 1.0))
        error = np.cumsum([0.0, *velocity])
        velocity /= math.sqrt(np.mean(velocity**2))
        jumps = [at for at, one in enumerate(velocity) if abs(one) > 2.0]
        stands = [abs(one) < 0.2 for one in velocity]
        between = [
            sum(stands[a + 1 : b]) / max(1, b - a - 1)
            for a, b in itertools.pairwise(jumps)
            if velocity[a] * velocity[b] < 0.0
        ]
        bursts = bool(between) and np.mean(between) < 0.25 * np.mean(stands)
        jumping = np.mean(velocity**4) >= 4.5
        for samples, period in ((1, 0.01), (1, 0.002), (4, 0.0005)):
            found = causes.stick_slip(np.repeat(error, samples), period)
            assert found == (jumping and np.mean(stands) >= 0.4 and not bursts)
        outcomes.add((found, bursts))
    assert outcomes == {(True, False), (False, True), (False, False)}
    assert not causes.stick_slip(np.ones(9), T) and not causes.stick_slip(error[:3], T)


@pytest.mark.parametrize(
    ("friction", "drag", "waves", "found"),
    [
        *((0.03, 0.05, 3.0, 0.05), (-0.03, -0.05, 3.0, 0.05), (0.0, 0.05, 3.0, 0.05), (0.0, 0.05, 1.0, 0.05)),
        *((0.06, 0.05, 3.0, 0.0), (0.0, 0.0, 3.0, 0.0)),
        # The platform moves one way with the stage.
        *((0.0, 0.05, 0.25, 0.0), (0.0, 0.05, -0.25, 0.0)),
    ],
)
def test_drag_is_told_from_friction_an_offset_and_a_spring(friction, drag, waves, found):
    r, ways = 10e-6 * np.sin(2.0 * np.pi * waves * THERE_AND_BACK), np.where(TIME < 4.0, 1.0, -1.0)
    error = np.where(np.isin(np.arange(TIME.size) % 8000, range(100)), 2e-6, 1e-9)
    current = 0.2 + 500.0 * r + friction * np.sign(np.gradient(r)) + drag * ways
    run = {"r": r, "x": THERE_AND_BACK, "y": r, "current": current}
    assert dragging(motion(error, **run)) == pytest.approx(found, abs=1e-3)
    # A cable pushes back too, the more the farther the stage has come.
    assert dragging(motion(error, **{**run, "current": current + 0.5 * THERE_AND_BACK})) == pytest.approx(
        found, abs=1e-3
    )
    # Neither an error that is made everywhere, nor a current that mostly does something else.
    assert dragging(motion(3e-6 + error, **run)) == 0.0
    assert dragging(motion(error, **{**run, "current": current + 0.1 * np.sin(40.0 * TIME)})) == 0.0
    # Nor strokes of one way, nor a stage that stands.
    assert (
        dragging(motion(error, **{**run, "x": 0.2 * TIME})) == dragging(motion(error, **{**run, "x": 0.0 * r})) == 0.0
    )


def test_white_noise_has_no_cause_whether_the_stage_makes_strokes_or_not(random):
    noise = 1e-7 * random.standard_normal(TIME.size)
    for x in (THERE_AND_BACK, 0.2 * TIME, 0.1 * np.sin(1e-6 * TIME), 1e-7 * np.round(0.5 * np.sin(TIME))):
        run = motion(noise, x=x, r=1e-5 * np.sin(TIME))
        assert of_error(run) == causes.UNKNOWN and locked_to_x(run) is None


def test_noise_that_is_as_large_at_rest_is_said_to_be_from_half_of_the_error_on(random):
    noise = 1e-7 * random.standard_normal(TIME.size)
    for share, words in ((1.0, "as large at rest"), (0.6, "as large at rest"), (0.4, causes.UNKNOWN)):
        error = np.where(STILL, share * noise + 4e-8, noise)
        assert words in of_error(motion(error, x=PAUSED, r=1e-5 * np.sin(TIME)))


@pytest.mark.parametrize(("back", "found"), [(-1.0, True), (1.0, True), (0.0, False)])
def test_an_error_of_few_waves_is_the_places_if_the_way_back_has_it_with_either_sign(back, found, random):
    time = np.arange(4000) * T
    x = 1.0 - np.abs(time - 1.0)
    ways = np.where(time < 1.0, 1.0, back)
    error = 1e-7 * np.sin(6.0 * np.pi * x) * ways + 2e-8 * random.standard_normal(time.size)
    error[time >= 1.0] += (back == 0.0) * 1e-7 * np.sin(11.0 * np.pi * x[time >= 1.0])
    run = motion(error, x=x, r=1e-5 * np.sin(2.0 * np.pi * 1.7 * time))
    assert ("same at each place" in of_error(run)) == found


def map_of(deviation, step):
    x = np.arange(0.0, 1.7601, step)
    return StraightnessMap(one_run(x, deviation(x)), MapParameters(max_gap=0.2, min_points=5, smooth="none"))


@pytest.mark.parametrize("line", [0.0, 1.0])
def test_a_map_that_does_not_fit_its_guide_is_explained_by_what_was_done_to_it_beside_any_straight_line(line):
    true, x, random = GUIDE.deviations, np.linspace(0.02, 1.74, 2000), np.random.default_rng(1)
    added = line * (3e-6 - 40e-6 * x)
    surveys = {
        "shift its x by -3 mm": lambda at: true(at - 3e-3),
        "opposite sign": lambda at: -true(at),
        "multiplied by 2:": lambda at: 0.5 * true(at),
        "bowed by 2 µm": lambda at: true(at) + 2e-6 * ((at - 0.88) / 0.86) ** 2,
        "use a survey of this guide": lambda at: 9e-6 * np.sin(2.0 * np.pi * 3.3 * at / 1.76 + 1.0),
    }
    for said, deviation in surveys.items():
        found = map_of(deviation, 0.01)
        for known in (found, None):
            assert said in of_map(x, true(x) - found.deviations(x) + added, found.deviations, known), said
    noisy = map_of(lambda at: true(at) + random.normal(0.0, 0.5e-6, at.size), 0.01)
    words = of_map(x, true(x) - noisy.deviations(x), noisy.deviations, noisy)
    assert "no run was repeated: repeat its runs" in words
    flat, bends = map_of(lambda at: 1e-9 * np.cos(at), 0.11), map_of(true, 0.11)
    to_one_side = 1e-6 * (1.0 - np.cos(2.0 * np.pi * x / 0.11))
    for sparse, left in ((flat, to_one_side), (bends, true(x) - bends.deviations(x))):
        assert "110 mm apart: survey more points" in of_map(x, left + added, sparse.deviations, sparse)


@pytest.mark.parametrize(("begin", "friction"), [(0.0, True), (-0.1, False)])
def test_an_error_is_frictions_where_it_is_made_within_a_tenth_of_a_second_after_a_reversal(begin, friction, random):
    error = 2e-8 * random.standard_normal(TIME.size)
    for number, turn in enumerate(np.arange(0.5, 4.8, 1.0) / 0.6):
        error[(turn + begin < TIME) & (turn + begin + 0.1 > TIME)] += 0.5e-6 * (-1.0) ** (number // 2)
    run = motion(error, r=10e-6 * np.sin(2.0 * np.pi * 0.3 * TIME))
    assert ("where the platform reverses" in of_error(run)) == friction
