"""Which frames of several messages are one sample: by their counts, or by their times."""

import pytest

from straightcomp_ros.hardware.can.frames import Report
from straightcomp_ros.hardware.can.sample_numbers import OPEN, FrameSets, together

PERIOD = 500_000


def x(number):
    return Report(alive=number % 15, x=float(number))


def y(number):
    return Report(alive=number % 15, y=float(number))


def fed(sets, frames):
    """The whole samples of frames, each (message, frame, time in periods), as pairs of their x and y."""
    whole = [sets.add(part, frame, frame.alive, round(at * PERIOD)) for part, frame, at in frames]
    return [(one[0].x, one[0].y) for one in whole if one is not None]


def in_turn(numbers):
    for number in numbers:
        yield 0, x(number), number
        yield 1, y(number), number + 0.1


@pytest.fixture(params=[15, 0], ids=["by counts", "by times"])
def sets(request):
    return FrameSets(2, request.param, PERIOD)


def test_each_sample_of_a_good_bus_is_whole(sets):
    assert fed(sets, in_turn(range(100))) == [(k, k) for k in range(100)]
    assert sets.incomplete == sets.repeated == sets.out_of_order == 0


@pytest.mark.parametrize("lost", [0, 1])
def test_a_sample_of_which_a_frame_is_lost_is_counted_and_not_used(sets, lost):
    frames = [frame for frame in in_turn(range(30)) if not (frame[0] == lost and frame[2] // 1 == 7)]
    assert fed(sets, frames) == [(k, k) for k in range(30) if k != 7]
    assert sets.incomplete == 1


def test_frames_of_two_samples_that_are_swapped_find_their_own_by_their_counts():
    sets = FrameSets(2, 15, PERIOD)
    frames = [(0, x(1), 1), (0, x(2), 2), (1, y(1), 2.1), (1, y(2), 2.2), (0, x(3), 3), (1, y(3), 3.1)]
    assert fed(sets, frames) == [(1, 1), (2, 2), (3, 3)]
    assert sets.out_of_order == 1 and sets.incomplete == 0


def test_a_frame_that_comes_after_a_later_sample_is_whole_makes_no_sample():
    sets = FrameSets(2, 15, PERIOD)
    frames = [(0, x(1), 1), (0, x(2), 2), (1, y(2), 2.1), (1, y(1), 2.2), (0, x(3), 3), (1, y(3), 3.1)]
    assert fed(sets, frames) == [(2, 2), (3, 3)]
    assert sets.incomplete == 1


def test_a_repeated_frame_is_counted_and_makes_no_second_sample():
    sets = FrameSets(2, 15, PERIOD)
    frames = [(0, x(1), 1), (0, x(1), 1.05), (1, y(1), 1.1), (1, y(1), 1.2), (0, x(1), 1.3)]
    assert fed(sets, frames) == [(1, 1)]
    assert sets.repeated == 3


def test_a_frame_of_another_sample_with_the_same_count_is_not_taken_for_its_own():
    sets = FrameSets(2, 15, PERIOD)
    # Fifteen samples of which every y is lost, and at last an x.
    frames = [(0, x(0), 0), (1, y(15), 15.1), (0, x(15), 15.2)]
    assert fed(sets, frames) == [(15, 15)]


def test_frames_without_counts_that_are_half_a_period_apart_are_of_two_samples():
    sets = FrameSets(2, 0, PERIOD)
    assert fed(sets, [(1, y(0), 0.1), (0, x(1), 0.7), (1, y(1), 0.8)]) == [(1, 1)]
    assert sets.incomplete == 1


def test_as_many_samples_as_may_wait_do_so_and_the_oldest_of_more_is_given_up():
    sets = FrameSets(2, 15, PERIOD)
    assert fed(sets, [(0, x(k), 0.1 * k) for k in range(OPEN + 1)]) == []
    assert sets.incomplete == 1
    assert fed(sets, [(1, y(k), 0.5) for k in range(1, OPEN + 1)]) == [(k, k) for k in range(1, OPEN + 1)]


def test_what_was_before_a_reset_is_forgotten():
    sets = FrameSets(2, 15, PERIOD)
    assert fed(sets, [(0, x(1), 1)]) == []
    sets.reset()
    assert fed(sets, [(1, y(1), 1.1)]) == []


def test_the_time_of_a_whole_sample_is_that_of_its_first_frame():
    sets = FrameSets(2, 15, PERIOD)
    assert sets.add(1, y(1), 1, 100) is None
    assert sets.add(0, x(1), 1, 250) == (Report(alive=1, x=1.0, y=1.0), 100)


def test_a_whole_is_good_if_each_of_its_frames_is():
    assert together([x(1), y(1)]).good
    assert not together([x(1), y(1)._replace(good=False)]).good
    assert together([Report(alive=3, x=1.0), Report(alive=4, current=0.5)]) == Report(alive=3, x=1.0, current=0.5)
