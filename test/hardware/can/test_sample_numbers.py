"""Number and time of a sample: which frames belong to it, its number from a counter that wraps, its place on a line."""

from unittest.mock import Mock

import numpy as np
import pytest

from straightcomp_ros.hardware.can.frames import Report
from straightcomp_ros.hardware.can.sample_numbers import BLOCK, OPEN, FrameSets, SampleClock, SampleNumbers

PERIOD = 500_000
START = 1_700_000_000_123_456_789
ALIVE_MODULUS, COUNTER_MODULUS = 15, 15 * 2**28


def x(number):
    return 0, Report(alive=number % 15, x=float(number))


def y(number):
    return 1, Report(alive=number % 15, y=float(number))


def fed(sets, frames):
    """The whole samples of frames, each (frame, time in periods), as pairs of their x and y."""
    whole = [sets.add(part, frame, frame.alive, round(at * PERIOD)) for (part, frame), at in frames]
    return [(one[0].x, one[0].y) for one in whole if one is not None]


@pytest.mark.parametrize("modulus", [15, 0], ids=["by counts", "by times"])
@pytest.mark.parametrize("lost", [None, x, y])
def test_each_sample_is_whole_unless_a_frame_of_it_is_lost_which_is_counted(modulus, lost):
    sets = FrameSets(2, modulus, PERIOD)
    in_turn = [(frame, k, k + late) for k in range(100) for frame, late in ((x, 0.0), (y, 0.1))]
    frames = [(frame(k), at) for frame, k, at in in_turn if not (frame is lost and k == 7)]
    assert fed(sets, frames) == [(k, k) for k in range(100) if lost is None or k != 7]
    assert (sets.incomplete, sets.repeated, sets.out_of_order) == (int(lost is not None), 0, 0)


THIRD = [(x(3), 3), (y(3), 3.1)]


@pytest.mark.parametrize(
    ("modulus", "frames", "whole", "counters"),
    [
        # Frames of two samples that are swapped find their own by their counts.
        (15, [(x(1), 1), (x(2), 2), (y(1), 2.1), (y(2), 2.2), *THIRD], [1, 2, 3], (0, 0, 1)),
        # One that comes after a later sample is whole makes none.
        (15, [(x(1), 1), (x(2), 2), (y(2), 2.1), (y(1), 2.2), *THIRD], [2, 3], (1, 0, 1)),
        (15, [(x(1), 1), (x(1), 1.05), (y(1), 1.1), (y(1), 1.2), (x(1), 1.3)], [1], (0, 3, 0)),
        # Fifteen samples of which every y is lost, and at last an x: another sample has the same count.
        (15, [(x(0), 0), (y(15), 15.1), (x(15), 15.2)], [15], (1, 0, 0)),
        # Without counts, frames half a period apart are of two samples.
        (0, [(y(0), 0.1), (x(1), 0.7), (y(1), 0.8)], [1], (1, 0, 0)),
        (15, [*((x(k), 0.1 * k) for k in range(OPEN)), *((y(k), 0.5) for k in range(OPEN))], [0, 1, 2], (0, 0, 2)),
        (15, [(x(k), 0.1 * k) for k in range(OPEN + 1)], [], (1, 0, 0)),
    ],
    ids=["swapped", "late", "repeated", "the same count", "half a period apart", "as many as may wait", "one more"],
)
def test_frames_that_come_in_another_order_make_no_wrong_sample(modulus, frames, whole, counters):
    sets = FrameSets(2, modulus, PERIOD)
    assert fed(sets, frames) == [(k, k) for k in whole]
    assert (sets.incomplete, sets.repeated, sets.out_of_order) == counters


def test_a_whole_sample_has_the_time_of_its_first_frame_is_good_if_all_are_and_has_none_of_what_was_before_a_reset():
    sets = FrameSets(2, 15, PERIOD)
    assert sets.add(*y(1), 1, 100) is None
    assert sets.add(*x(1), 1, 250) == (Report(alive=1, x=1.0, y=1.0), 100)
    sets.add(*x(2), 2, 600)
    assert not sets.add(1, y(2)[1]._replace(good=False), 2, 700)[0].good
    assert fed(sets, [(x(9), 9)]) == []
    sets.reset()
    assert fed(sets, [(y(9), 9.1)]) == []


def followed(ppm, lateness_ns, lost=0.0, count=40_000, seed=1):
    """Errors in ns of the stamps as they are given, and the stamps."""
    random = np.random.default_rng(seed)
    clock, errors, stamps = SampleClock(PERIOD), [], []
    for index in range(count):
        true_ns = START + round(index * PERIOD * (1 + ppm * 1e-6))
        if random.random() < lost:
            continue
        clock.observe(index, true_ns + round(lateness_ns(index, random)))
        if clock.settled:
            stamps.append(clock.stamp(index))
            errors.append(stamps[-1] - true_ns)
    return np.array(errors), stamps


def stall(index, random):
    end = 20_000 + 400
    return (end - index) * PERIOD if 20_000 <= index < end else random.exponential(20_000)


@pytest.mark.parametrize("ppm", [-900, -100, 0, 100, 900])
def test_the_clock_follows_a_quartz_through_jitter_and_losses(ppm):
    errors, stamps = followed(ppm, lambda _, random: 100_000 + random.exponential(60_000), lost=0.05)
    # Late by the promptest frame's 100 µs, to a fiftieth of a period.
    assert np.abs(errors[20 * BLOCK :] - 100_000).max() < PERIOD / 50
    assert np.diff(stamps).min() > 0


@pytest.mark.parametrize(
    ("ppm", "lateness", "count", "begin", "first", "largest"),
    [
        (50, stall, 40_000, 15_000, None, PERIOD / 5),
        (0, lambda index, _: 20_000_000 - 500_000 * index if index < 40 else 0, 1000, 0, None, 100),
        (0, lambda index, _: 5_000_000 if index < 2 * BLOCK else 0, 20 * BLOCK, 12 * BLOCK, 5_000_000, PERIOD / 5),
    ],
    ids=["a stall of the host", "a first sample that is late", "a line that was drawn too late"],
)
def test_what_is_late_for_a_while_does_not_make_the_stamps_late_for_long(ppm, lateness, count, begin, first, largest):
    errors, stamps = followed(ppm, lateness, count=count)
    assert np.abs(errors[begin:]).max() < largest and first in (None, errors[0])
    assert len(stamps) == count - (BLOCK - 1)
    assert np.diff(stamps).min() > 0


@pytest.mark.parametrize(("begin", "end"), [(0, 100), (30, 2 * BLOCK)])
@pytest.mark.parametrize("ratio", [0.5, 0.8, 1.25, 2.0])
def test_a_board_at_another_rate_is_found_in_the_first_block_and_a_host_that_stood_still_waits_for_the_next(
    ratio, begin, end
):
    other, stalled = SampleClock(PERIOD), SampleClock(PERIOD)
    for index in range(3 * BLOCK):
        other.observe(index, START + round(index * ratio * PERIOD))
        # All that came while the host stood still is read at once.
        stalled.observe(index, START + PERIOD * (index if index < begin else max(index, end)))
    assert not other.settled and other.other_rate == pytest.approx(2000.0 / ratio)
    assert stalled.settled and stalled.other_rate == 0.0
    assert abs(stalled.stamp(3 * BLOCK) - START - 3 * BLOCK * PERIOD) < 0.1 * PERIOD


def test_a_clock_that_was_interrupted_is_found_again_and_time_gives_the_number_of_samples_since():
    clock = SampleClock(PERIOD)
    for index in range(4000):
        clock.observe(index, START + index * PERIOD + (50 * PERIOD if index > 2000 else 0))
    assert clock.settled and clock.stamp(4000) - (START + 4050 * PERIOD) == pytest.approx(0, abs=1)
    assert clock.elapsed(3999, START + 4056 * PERIOD) == pytest.approx(7)


CLOCK = Mock(settled=True, elapsed=lambda index, arrival_ns: arrival_ns / PERIOD - index)
"""Sample n comes at n periods."""


def sequence(newest=None):
    """A sequence with a full counter in frames of its own; ``newest`` is its newest sample."""
    found = SampleNumbers(CLOCK, PERIOD, ALIVE_MODULUS, COUNTER_MODULUS)
    if newest is not None:
        found.accept(newest, 1, 0)
    return found


@pytest.mark.parametrize("number", [0, 7, 14, 15, 29, 1000])
def test_a_classic_frame_is_placed_while_fewer_than_ten_samples_have_passed_and_may_seem_four_samples_early(number):
    def found(ahead, early=0):
        return sequence(number).ahead((number + ahead) % ALIVE_MODULUS, (number + ahead - early) * PERIOD)

    assert [found(ahead) for ahead in range(1, 40)] == [*range(1, 10)] + [None] * 30
    # Five samples ahead of the clock: it is taken for one that was there before.
    assert [found(5, early) for early in range(6)] == [5] * 5 + [5 - ALIVE_MODULUS]


def test_a_counter_from_the_future_or_from_half_a_second_ago_is_not_plausible():
    found = sequence(5000)
    now = 5010 * PERIOD
    assert [found.plausible(ahead, now) for ahead in (-1000, -999, 0, 14, 15)] == [False, True, True, True, False]
    assert sequence().plausible(10**6, now)


def test_the_newest_256_samples_that_were_lost_may_still_come_once_and_any_other_old_one_counts_as_repeated():
    found = sequence(0)
    for _ in range(2):
        found.accept(0, 200, 0)
    missing = sorted({*range(1, 200), *range(201, 400)})[-256:]
    assert (found.index, found.lost) == (400, 398)
    # Once more, those that came in time, and one that has been lost for too long.
    for number in (missing[0], missing[-1], missing[-1], 400, 200, missing[0] - 1):
        found.count_old(number - 400)
    assert (found.lost, found.out_of_order, found.repeated) == (396, 2, 4)


@pytest.mark.parametrize(("modulus", "told_apart"), [(256, 251), (16, 11), (4, 2)])
def test_numbers_start_anew_after_a_silence_that_a_board_s_only_count_cannot_tell(modulus, told_apart):
    for silence in range(1, told_apart + 1):
        found = SampleNumbers(CLOCK, PERIOD, modulus)
        found.accept(100, 1, 0)
        anew = silence == told_apart
        assert found.ahead((100 + silence) % modulus, (100 + silence) * PERIOD) == (1 if anew else silence)
        assert found.jumps == anew and (found.index is None) == anew


@pytest.mark.parametrize(("modulus", "most"), [(15, 13), (16, 13), (4, 2), (0, 1)])
def test_until_the_clock_has_settled_no_more_samples_may_have_passed_than_the_count_tells(modulus, most):
    for arrival_ns in (0, PERIOD // 2):
        found = SampleNumbers(Mock(settled=False), PERIOD, modulus)
        found.accept(7, 1, 0)
        ahead = [found.ahead((7 + k) % modulus if modulus else None, arrival_ns) for k in range(1, modulus or 2)]
        assert ahead == [*range(1, most + 1), *range(most + 1 - modulus, 0)]
    # After a silence the time counts.
    assert found.ahead(0 if modulus else None, 12 * PERIOD) == 1 and found.jumps == 1


@pytest.mark.parametrize("lost", [0, 1, 3])
def test_frames_without_a_count_that_are_late_singly_lose_nothing_and_eight_in_a_row_show_what_was_lost(lost):
    found, late = SampleNumbers(CLOCK, PERIOD, 0), (0.0, 3.0, 0.2)
    for k in range(100):
        taken = k + lost * (k >= 50)
        arrival = round((taken + late[k % 3]) * PERIOD)
        number = found.accept(None, found.ahead(None, arrival), arrival)
        assert 50 <= k < 57 or number == taken
    assert found.lost == lost and found.jumps == 0


@pytest.mark.parametrize("newest", [None, 900])
@pytest.mark.parametrize(("counter", "late"), [(1000, 0), (1000, 14.9), (1000, 15), (1001, 1), (999, 0), (1015, 15)])
def test_a_full_counter_numbers_the_last_frame_that_waits_if_it_is_that_of_its_sample(newest, counter, late):
    found = sequence(newest)
    for number in (998, 1000):
        assert found.ahead(number % ALIVE_MODULUS, number * PERIOD) is None
        found.wait(Report(number % ALIVE_MODULUS), number * PERIOD)
    placed = found.place(counter, round((1000 + late) * PERIOD))
    fits = counter == 1000 and late < 15
    assert placed == ((Report(10, 1000), 100 if newest else 1, 1000 * PERIOD) if fits else None)
    assert found.place(1000, 1000 * PERIOD) is None


def test_a_counter_that_does_not_fit_starts_the_numbers_anew():
    for counter, jumps in ((99, 0), (100, 0), (113, 0), (114, 1), (98, 1), (5000, 1)):
        found = sequence(100)
        assert found.place(counter, counter * PERIOD) is None
        assert found.jumps == jumps and (found.index is None) is bool(jumps)
    assert sequence().place(5000, 5000 * PERIOD) is None
