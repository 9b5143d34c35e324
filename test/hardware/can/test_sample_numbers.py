"""Number and time of a sample: which frames belong to it, its number from a counter that wraps, its place on a line."""

import random

import numpy as np
import pytest

from straightcomp_ros.hardware.can.frames import Report
from straightcomp_ros.hardware.can.sample_numbers import BLOCK, OPEN, FrameSets, SampleClock, SampleNumbers, together

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


def test_a_whole_sample_has_the_time_of_its_first_frame_and_none_of_what_was_before_a_reset():
    sets = FrameSets(2, 15, PERIOD)
    assert sets.add(*y(1), 1, 100) is None
    assert sets.add(*x(1), 1, 250) == (Report(alive=1, x=1.0, y=1.0), 100)
    assert fed(sets, [(x(9), 9)]) == []
    sets.reset()
    assert fed(sets, [(y(9), 9.1)]) == []


def test_a_whole_has_each_field_of_the_first_that_has_it_and_is_good_if_each_of_its_frames_is():
    frames = [x(1)[1], y(1)[1]]
    assert together(frames).good
    assert not together([frames[0], frames[1]._replace(good=False)]).good
    assert together([Report(alive=3, x=1.0), Report(alive=4, current=0.5)]) == Report(alive=3, x=1.0, current=0.5)


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


@pytest.mark.parametrize("ppm", [-100, 0, 100])
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
    assert np.diff(stamps).min() > 0


def test_a_clock_that_was_interrupted_is_found_again_and_time_gives_the_number_of_samples_since():
    clock = SampleClock(PERIOD)
    for index in range(4000):
        clock.observe(index, START + index * PERIOD + (50 * PERIOD if index > 2000 else 0))
    assert clock.settled and clock.stamp(4000) - (START + 4050 * PERIOD) == pytest.approx(0, abs=1)
    assert clock.elapsed(3999, START + 4056 * PERIOD) == pytest.approx(7)


class Clock:
    """Sample n comes at n periods."""

    settled = True

    def elapsed(self, index, arrival_ns):
        return arrival_ns / PERIOD - index

    def observe(self, index, arrival_ns):
        pass

    def reset(self):
        pass


def sequence(modulus=ALIVE_MODULUS, full_modulus=COUNTER_MODULUS):
    """A full counter comes in frames of its own."""
    return SampleNumbers(Clock(), PERIOD, modulus, full_modulus)


def waiting(*numbers):
    """A sequence for which frames of these samples wait, each of which came at its time."""
    found = at(900)
    for number in numbers:
        found.wait(Report(number % ALIVE_MODULUS), number * PERIOD)
    return found


def placed(found, counter, at_number):
    return [number for number, *_ in found.place(counter, at_number * PERIOD)]


def at(number, modulus=ALIVE_MODULUS, full_modulus=COUNTER_MODULUS):
    """A sequence whose newest sample is ``number``."""
    found = sequence(modulus, full_modulus)
    found.accept(number, 1, 0)
    return found


@pytest.mark.parametrize("number", [0, 7, 14, 15, 29, 1000])
def test_a_classic_frame_is_placed_while_fewer_than_ten_samples_have_passed(number):
    for ahead in range(1, 10):
        assert at(number).ahead((number + ahead) % ALIVE_MODULUS, (number + ahead) * PERIOD) == ahead
    for ahead in range(10, 40):
        assert at(number).ahead((number + ahead) % ALIVE_MODULUS, (number + ahead) * PERIOD) is None


def test_a_classic_frame_may_seem_to_come_four_samples_early():
    for early in range(5):
        assert at(100).ahead(105 % ALIVE_MODULUS, (105 - early) * PERIOD) == 5
    # Five samples ahead of the clock: it is taken for one that was there before.
    assert at(100).ahead(105 % ALIVE_MODULUS, 100 * PERIOD) == 5 - ALIVE_MODULUS


def test_a_frame_waits_as_long_as_no_number_is_known_or_others_wait():
    assert sequence().ahead(3, 3 * PERIOD) is None
    assert waiting(905).ahead(906 % ALIVE_MODULUS, 906 * PERIOD) is None


def test_a_full_counter_goes_the_short_way_round():
    assert sequence(COUNTER_MODULUS, 0).ahead(12345, 0) == 1
    for index, counter, ahead in (
        (10, 13, 3),
        (10, 9, -1),
        (COUNTER_MODULUS - 1, 1, 2),
        (COUNTER_MODULUS + 1, COUNTER_MODULUS - 1, -2),
        (0, 100_000, 100_000),
    ):
        found = at(0, COUNTER_MODULUS, 0)
        found.index = index
        assert found.ahead(counter, (index + max(ahead, 0)) * PERIOD) == ahead


def test_a_counter_from_the_future_or_from_half_a_second_ago_is_not_plausible():
    found = at(5000)
    now = 5010 * PERIOD
    assert [found.plausible(ahead, now) for ahead in (-1000, -999, 0, 14, 15)] == [False, True, True, True, False]
    assert sequence().plausible(10**6, now)


def test_what_lies_between_two_samples_is_lost_until_it_comes_and_then_out_of_order():
    found = at(100)
    assert found.accept(0, 5, 0) == 105 and found.lost == 4
    for ahead in (-1, -4):
        found.count_old(ahead)
    assert (found.lost, found.out_of_order, found.repeated) == (2, 2, 0)
    # The same again, the newest itself, and one that was there before the gap.
    for ahead in (-1, 0, -5):
        found.count_old(ahead)
    assert (found.lost, found.out_of_order, found.repeated) == (2, 2, 3)


def test_only_the_last_256_missing_samples_are_remembered():
    found = at(0)
    found.accept(0, 200, 0)
    found.accept(0, 200, 0)
    assert found.lost == 398
    # The remembered ones are the newest; an older one counts as repeated.
    found.count_old(401 - 400 - 2)
    assert (found.out_of_order, found.repeated) == (1, 0)
    found.count_old(1 - 400)
    assert (found.out_of_order, found.repeated) == (1, 1)


def test_fourteen_frames_may_wait_and_the_oldest_of_more_is_given_up():
    found = sequence()
    for number in range(16):
        found.wait(Report(number % ALIVE_MODULUS), number)
    assert found.unplaced == 2
    assert [(number, arrival) for number, _, arrival in found.place(15, 15)] == [(k, k) for k in range(2, 16)]
    assert found.place(15, 15) == []


@pytest.mark.parametrize(
    ("numbers", "counter", "counted_at"),
    [
        ((992, 995, 1000), 1000, 1000),
        # The counter is that of a sample after the newest that came, or of the one before it.
        ((992, 995, 1000), 1007, 1007),
        ((999, 1000, 1001), 1000, 1001),
        # As many may be lost as the count distinguishes.
        *(((1000, 1001 + lost), 1001 + lost, 1001 + lost) for lost in range(14)),
    ],
)
def test_waiting_frames_are_placed_by_a_full_counter_that_comes_near_the_newest(numbers, counter, counted_at):
    assert placed(waiting(*numbers), counter, counted_at) == list(numbers)


@pytest.mark.parametrize("known", [True, False], ids=["numbers known before", "no number known"])
@pytest.mark.parametrize("order", [(0, 2, 1, 3), (1, 0, 2, 3), (0, 1, 3, 2), (0, 3, 1, 2), (1, 1, 0, 0)])
def test_frames_that_were_swapped_while_they_waited_are_placed_all_the_same(order, known):
    found = at(900) if known else sequence()
    numbers = [1000 + place for place in order]
    for turn, number in enumerate(numbers):
        found.wait(Report(number % ALIVE_MODULUS), (1000 + turn) * PERIOD)
    assert placed(found, 1003, 1003) == numbers


def test_a_counter_that_does_not_fit_starts_the_numbers_anew():
    for counter, jumps in ((99, 0), (100, 0), (113, 0), (114, 1), (98, 1), (5000, 1)):
        found = at(100)
        assert found.place(counter, counter * PERIOD) == []
        assert found.jumps == jumps and (found.index is None) is bool(jumps)
    assert sequence().place(5000, 5000 * PERIOD) == []


@pytest.mark.parametrize(("modulus", "told_apart"), [(256, 251), (16, 11), (4, 2)])
def test_a_board_without_a_full_counter_starts_anew_after_a_silence_that_its_count_cannot_tell(modulus, told_apart):
    for silence in range(1, told_apart):
        found = at(100, modulus, 0)
        assert found.ahead((100 + silence) % modulus, (100 + silence) * PERIOD) == silence and found.jumps == 0
    found = at(100, modulus, 0)
    assert found.ahead((100 + told_apart) % modulus, (100 + told_apart) * PERIOD) == 1
    assert found.jumps == 1 and found.index is None


def test_frames_without_a_count_are_numbered_in_their_order_however_late_each_is():
    found = sequence(0, 0)
    chance = random.Random(1)
    for number in range(1000):
        late = chance.choice([0.0, 0.2, 3.0])
        ahead = found.ahead(None, round((number + late) * PERIOD))
        assert ahead == 1 and found.accept(None, ahead, 0) == number
    assert found.lost == 0


@pytest.mark.parametrize("lost", [1, 3])
def test_samples_lost_before_frames_without_a_count_are_found_after_eight_frames(lost):
    found = sequence(0, 0)
    number = 0
    for k in range(100):
        taken = k if k < 50 else k + lost
        number = found.accept(None, found.ahead(None, taken * PERIOD), taken * PERIOD)
        if not 50 <= k < 57:
            assert number == taken
    assert found.lost == lost
