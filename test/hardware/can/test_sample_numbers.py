"""The number of a sample from a counter that wraps: never guessed, and what is missing is counted once."""

import pytest

from straightcomp_ros.hardware.can.frames import ALIVE_MODULUS, COUNTER_MODULUS, Encoder
from straightcomp_ros.hardware.can.sequence import Sequence

PERIOD = 500_000


def sequence():
    """By a clock at which sample n comes at n periods."""
    return Sequence(lambda index, arrival_ns: arrival_ns / PERIOD - index)


def classic(number):
    return Encoder(number % ALIVE_MODULUS, 0, 0, 0, None, None)


def full(number):
    return Encoder(number % ALIVE_MODULUS, 0, 0, 0, 0, number % COUNTER_MODULUS)


def at(number):
    """A sequence whose newest sample is ``number``."""
    found = sequence()
    found.accept(full(number), 1)
    return found


@pytest.mark.parametrize("number", [0, 7, 14, 15, 29, 1000])
def test_a_classic_frame_is_placed_while_fewer_than_ten_samples_have_passed(number):
    for ahead in range(1, 10):
        assert at(number).ahead(classic(number + ahead), (number + ahead) * PERIOD) == ahead
    for ahead in range(10, 40):
        assert at(number).ahead(classic(number + ahead), (number + ahead) * PERIOD) is None


def test_a_classic_frame_may_seem_to_come_four_samples_early():
    for early in range(5):
        assert at(100).ahead(classic(105), (105 - early) * PERIOD) == 5
    # Five samples ahead of the clock: it is taken for one that was there before.
    assert at(100).ahead(classic(105), 100 * PERIOD) == 5 - ALIVE_MODULUS


def test_a_frame_waits_as_long_as_no_number_is_known_or_others_wait():
    assert sequence().ahead(classic(3), 3 * PERIOD) is None
    waiting = at(100)
    waiting.wait(classic(112), 112 * PERIOD)
    assert waiting.ahead(classic(113), 113 * PERIOD) is None
    assert waiting.ahead(full(113), 113 * PERIOD) == 13


def test_a_full_counter_goes_the_short_way_round():
    assert sequence().ahead(full(12345), 0) == 1
    for index, counter, ahead in (
        (10, 13, 3),
        (10, 9, -1),
        (COUNTER_MODULUS - 1, COUNTER_MODULUS + 1, 2),
        (COUNTER_MODULUS + 1, COUNTER_MODULUS - 1, -2),
        (0, COUNTER_MODULUS // 2 - 1, COUNTER_MODULUS // 2 - 1),
        (0, COUNTER_MODULUS // 2, -COUNTER_MODULUS // 2),
    ):
        found = at(0)
        found.index = index
        assert found.ahead(full(counter), 0) == ahead


def test_a_counter_from_the_future_or_from_half_a_second_ago_is_not_plausible():
    found = at(5000)
    now = 5010 * PERIOD
    assert [found.plausible(ahead, now) for ahead in (-1000, -999, 0, 14, 15)] == [False, True, True, True, False]
    assert sequence().plausible(10**6, now)


def test_what_lies_between_two_samples_is_lost_until_it_comes_and_then_out_of_order():
    found = at(100)
    assert found.accept(full(105), 5) == 105
    assert found.lost == 4
    for ahead in (-1, -4):
        found.count_old(ahead)
    assert (found.lost, found.out_of_order, found.repeated) == (2, 2, 0)
    # The same again, the newest itself, and one that was there before the gap.
    for ahead in (-1, 0, -5):
        found.count_old(ahead)
    assert (found.lost, found.out_of_order, found.repeated) == (2, 2, 3)


def test_the_first_frame_of_all_loses_nothing():
    found = sequence()
    assert found.accept(full(77), 1) == 77 and found.lost == 0
    found.count_old(0)
    assert found.repeated == 1


def test_only_the_last_256_missing_samples_are_remembered():
    found = at(0)
    found.accept(full(200), 200)
    found.accept(full(400), 200)
    assert found.lost == 398
    # The remembered ones are the newest; an older one counts as repeated.
    found.count_old(401 - 400 - 2)
    assert (found.out_of_order, found.repeated) == (1, 0)
    found.count_old(1 - 400)
    assert (found.out_of_order, found.repeated) == (1, 1)


def test_fourteen_frames_may_wait_and_the_oldest_of_more_is_given_up():
    found = sequence()
    for number in range(16):
        found.wait(classic(number), number)
    assert found.unplaced == 2
    placed = found.place(15, 0)
    assert [number for number, _ in placed] == list(range(2, 16))
    assert [waiting[1] for _, waiting in placed] == list(range(2, 16))
    assert found.place(15, 0) == []


def test_waiting_frames_are_placed_by_a_counter_that_came_with_the_newest_or_after_it():
    for newest in (1000, 1007):
        found = at(980)
        for number in (992, 995, 1000):
            found.wait(classic(number), number * PERIOD)
        # The counter is that of sample ``newest``; the newest frame that was heard is 1000.
        assert [number for number, _ in found.place(newest, 1000 % ALIVE_MODULUS)] == [992, 995, 1000]


def test_a_counter_that_does_not_fit_starts_the_numbers_anew():
    for counter, jumps in ((99, 0), (100, 0), (113, 0), (114, 1), (98, 1), (5000, 1)):
        found = at(100)
        assert found.place(counter, counter % ALIVE_MODULUS) == []
        assert found.jumps == jumps and (found.index is None) is bool(jumps)
    assert sequence().place(5000, 5) == []
