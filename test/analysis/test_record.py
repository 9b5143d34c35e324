"""When a stage moved, and which reference it had: the same from another zero of x, and backwards in time."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from straightcomp_ros.analysis.record import (
    MetricsError,
    Stroke,
    StrokeRecord,
    group_means,
    motion_of,
    runs_of,
    speed_at_end,
    strokes_and_jumps,
    whole_ways,
)

T = 1e-3
OTHER = {"forward": "backward", "backward": "forward"}
THIRD = np.flatnonzero(np.random.default_rng(2).random(1100) < 0.3)


def there_and_back(samples=400, way=0.04, rest=100):
    """x in m of a cycle with cosine ramps and rests, at the even."""
    there = 0.5 * way * (1.0 - np.cos(np.pi * np.arange(samples) / (samples - 1.0)))
    return np.concatenate(
        [np.zeros(rest), there, np.full(rest, way), 0.5 * there[::-1] + 0.5 * way, np.full(rest, 0.02)]
    )


def found(time, x):
    strokes, jumps = strokes_and_jumps(time, x)
    return [(one.start, one.stop, one.direction) for one in strokes], jumps.tolist()


@pytest.mark.parametrize("jump", [0.0, 2.5e-3, -0.3])
@pytest.mark.parametrize("lost", [(), (40, 41), (150, 152, 153, 154, 420), (298, 299), THIRD])
def test_strokes_and_jumps_are_the_same_from_another_zero_mirrored_and_backwards_in_time(jump, lost):
    x = there_and_back()
    x[300:] += jump
    kept = np.delete(np.arange(x.size), lost)
    time, x = kept * T, x[kept]
    strokes, jumps = found(time, x)
    at = int(np.searchsorted(kept, 300))
    assert jumps == ([at] if jump and not set(lost) & {299, 300} else [])
    if not jump:
        assert [way for *_, way in strokes] == ["forward", "backward"]
        # A stroke begins and ends with the sample that is more than a micrometre from where the stage rests.
        for (start, stop, _), (begin, end) in zip(strokes, ((0.0, 0.04), (0.04, 0.02)), strict=True):
            assert (abs(x[[start - 1, start]] - begin) > 1e-6).tolist() == [False, True]
            assert (abs(x[[stop - 1, stop]] - end) > 1e-6).tolist() == [True, False]
    motion = motion_of(time, x)
    assert motion.window == slice(strokes[0][0], strokes[-1][1])
    # Without the pause between them.
    for one in (None, *OTHER):
        within = [range(start, stop) for start, stop, way in strokes if one in (None, way)]
        assert motion.samples(one).tolist() == [at for samples in within for at in samples]
    assert found(time + 7.0, x - 3.0) == (strokes, jumps)
    mirrored = [(start, stop, OTHER[way]) for start, stop, way in strokes]
    assert found(time, -x) == (mirrored, jumps)
    backwards = [(x.size - stop, x.size - start, way) for start, stop, way in reversed(mirrored)]
    assert found(time[-1] - time[::-1], x[::-1]) == (backwards, [x.size - one for one in jumps])


def test_a_jump_is_more_than_the_way_that_any_motor_makes_in_a_period_however_long_that_is():
    for period, way in ((5e-4, 1e-3), (1e-3, 1e-3), (2e-3, 4e-3), (0.01, 0.1)):
        for part, jumps in ((0.95, 0), (1.05, 1)):
            x = 1e-4 * np.arange(60) + np.where(np.arange(60) < 30, 0.0, part * way)
            assert len(strokes_and_jumps(period * np.arange(60), x)[1]) == jumps


def test_four_samples_may_be_a_motion_that_has_begun_before_and_two_or_a_stage_that_stands_are_none():
    time = np.arange(4) * 0.1
    assert motion_of(time, 0.01 * np.arange(4)).strokes == (Stroke(1, 3, "forward"),)
    for count, words in ((2, "2 samples"), (3, r"does not move.*x stays within 0\.0002 mm")):
        with pytest.raises(MetricsError, match=words):
            motion_of(time[:count], 0.5 + 2e-7 * (np.arange(count) % 2))


def test_the_speed_at_the_end_is_that_of_a_parabola_and_is_known_from_the_samples_of_20_ms_on():
    for period, least in ((1e-3, 20), (5e-4, 40), (0.01, 5)):
        time = 3.0 + period * np.arange(200)
        x = 0.7 - 0.05 * (time - 3.1) + 0.9 * (time - 3.1) ** 2
        speed = abs(-0.05 + 1.8 * (time[-1] - 3.1))
        assert speed_at_end(time, x) == speed_at_end(time[-least:], x[-least:]) == pytest.approx(speed)
        assert speed_at_end(time[1 - least :], x[1 - least :]) == 0.0
        # Samples are lost among these, or before them.
        for lost, known in ((1 - least, False), (-2, False), (-least - 1, True)):
            with_gap = np.delete(time, lost), np.delete(x, lost)
            assert speed_at_end(*with_gap) == (pytest.approx(speed) if known else 0.0)


def record_of(x, r, **true):
    return StrokeRecord(T * np.arange(x.size), x, 0.0 * x, r, 0.0 * x, "law", **true)


def test_a_reference_with_two_tables_is_as_it_was_recorded_and_one_with_one_is_a_function_of_x():
    x, bend = there_and_back(), lambda x: 1e-5 * np.cos(100.0 * x)
    back = np.arange(x.size) > 550
    one, two, centred = (record_of(x, r) for r in (bend(x), bend(x) + np.where(back, 1.5e-9, 0.0), 0.0 * x))
    assert [run.reference.directed for run in (one, two, centred)] == [False, True, False]
    for run in (one, two):
        known = replace(run, true_x=x + 1e-4, true_y=0.0 * x)
        followed = run.r if run is two else bend(np.clip(x + 1e-4, x.min(), x.max()))
        assert known.true_error(known.reference) == pytest.approx(followed, abs=1e-9)
        assert run.guide_by(run.reference) == pytest.approx(-run.r, abs=1e-15)
    # Where r was another one, the guide is that of its map.
    assert record_of(x, 2.0 * one.r).guide_by(one.reference) == pytest.approx(-one.r, abs=1e-15)
    # A run one way, and one that has no motion, has one.
    assert not record_of(x[:400], two.r[:400]).reference.directed and not record_of(0.0 * x, x).reference.directed
    # Readings that are missing are no reference.
    holes = one.r.copy()
    holes[[150, 320]] = np.nan
    assert np.isfinite(record_of(x, holes).reference.evaluate(x)[0]).all()


def test_a_reference_is_known_between_recorded_positions_a_millimetre_from_each_other_and_not_beyond_them():
    x = np.array([0.0, 0.9e-3, 2.0e-3, 2.5e-3])
    at = np.array([-1e-6, 1e-6, 0.5e-3, 0.9e-3, 1.0e-3, 1.9e-3, 2.1e-3, 2.5e-3, 2.6e-3])
    known = [any(low < one <= high and high - low <= 1e-3 for low, high in itertools.pairwise(x)) for one in at]
    shuffled = np.array([2, 0, 3, 1])
    assert record_of(x[shuffled], 0.0 * x).reference.recorded_around(at).tolist() == known


@pytest.mark.parametrize(("part", "is_whole"), [(0.91, True), (0.89, False)])
def test_a_way_is_whole_from_nine_tenths_of_the_longest_on_also_in_parts_and_wherever_the_zero_of_x_lies(
    part, is_whole
):
    x = np.array([0.0, 0.4, 0.4, 1.0, 1.0, 1.0 - part, 1.0 - part, 1.0])
    directions = ("forward", "forward", "backward", "forward")
    strokes = [Stroke(2 * k, 2 * k + 2, way) for k, way in enumerate(directions)]
    mirrored = [replace(one, direction=OTHER[one.direction]) for one in strokes]
    for sign, ways in ((1.0, strokes), (-1.0, mirrored)):
        long, others = [ways[:2]], [[one] for one in ways[2:]]
        for zero in (-1.0, 0.0, 0.5, 9.0):
            assert whole_ways(ways, sign * (x - zero)) == ((long + others, []) if is_whole else (long, others))
        # The stage came back while nothing was recorded, by as much as the shortest stroke.
        for by, apart in ((0.04e-3, False), (0.06e-3, True)):
            parts, others = whole_ways(ways[:2], sign * np.array([0.0, 1.0, 1.0 - by, 2.0]))
            assert (len(parts), others) == (1 + apart, [])


def test_runs_of_a_mask_and_means_of_groups_are_those_of_loops():
    random = np.random.default_rng(1)
    mask = random.random(50) < 0.5
    runs = [at for begin, stop in runs_of(mask) for at in range(begin, stop)]
    assert runs == np.flatnonzero(mask).tolist() and not mask[[stop for _, stop in runs_of(mask) if stop < 50]].any()
    x, y, group = random.random(50), random.random(50), random.integers(-3, 4, 50)
    means = [[values[group == one].mean() for one in sorted(set(group.tolist()))] for values in (x, y)]
    assert np.array(group_means(x, y, group)) == pytest.approx(np.array(means))
