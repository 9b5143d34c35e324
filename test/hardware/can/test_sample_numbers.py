"""The number of a sample from a counter that wraps: never guessed, and what is missing is counted once."""

import random

import pytest

from straightcomp_ros.hardware.can.frames import Report
from straightcomp_ros.hardware.can.sample_numbers import SampleNumbers

PERIOD = 500_000
ALIVE_MODULUS, COUNTER_MODULUS = 15, 15 * 2**28


def sequence(modulus=ALIVE_MODULUS, full_modulus=COUNTER_MODULUS):
    """By a clock at which sample n comes at n periods; a full counter comes in frames of its own."""
    return SampleNumbers(lambda index, arrival_ns: arrival_ns / PERIOD - index, PERIOD, modulus, full_modulus)


def waiting(number):
    return Report(number % ALIVE_MODULUS)


def at(number, modulus=ALIVE_MODULUS, full_modulus=COUNTER_MODULUS):
    """A sequence whose newest sample is ``number``."""
    found = sequence(modulus, full_modulus)
    found.accept(number, 1)
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
    found = at(100)
    found.wait(waiting(105), 105 * PERIOD)
    assert found.ahead(106 % ALIVE_MODULUS, 106 * PERIOD) is None


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
    assert found.accept(0, 5) == 105
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
    assert found.accept(77, 1) == 77 and found.lost == 0
    found.count_old(0)
    assert found.repeated == 1


def test_only_the_last_256_missing_samples_are_remembered():
    found = at(0)
    found.accept(0, 200)
    found.accept(0, 200)
    assert found.lost == 398
    # The remembered ones are the newest; an older one counts as repeated.
    found.count_old(401 - 400 - 2)
    assert (found.out_of_order, found.repeated) == (1, 0)
    found.count_old(1 - 400)
    assert (found.out_of_order, found.repeated) == (1, 1)


def test_fourteen_frames_may_wait_and_the_oldest_of_more_is_given_up():
    found = sequence()
    for number in range(16):
        found.wait(waiting(number), number)
    assert found.unplaced == 2
    placed = found.place(15, 15)
    assert [number for number, _ in placed] == list(range(2, 16))
    assert [arrival for _, (_, arrival) in placed] == list(range(2, 16))
    assert found.place(15, 15) == []


def test_waiting_frames_are_placed_by_a_counter_that_came_with_the_newest_or_after_it():
    for newest in (1000, 1007):
        found = at(980)
        for number in (992, 995, 1000):
            found.wait(waiting(number), number * PERIOD)
        # The counter is that of sample ``newest``; the newest frame that was heard is 1000.
        assert [number for number, _ in found.place(newest, newest * PERIOD)] == [992, 995, 1000]


@pytest.mark.parametrize("known", [True, False], ids=["numbers known before", "no number known"])
@pytest.mark.parametrize("order", [(0, 2, 1, 3), (1, 0, 2, 3), (0, 1, 3, 2), (0, 3, 1, 2), (1, 1, 0, 0)])
def test_frames_that_were_swapped_while_they_waited_are_placed_all_the_same(order, known):
    found = at(900) if known else sequence()
    numbers = [1000 + place for place in order]
    for turn, number in enumerate(numbers):
        found.wait(waiting(number), (1000 + turn) * PERIOD)
    assert [number for number, _ in found.place(1003, 1003 * PERIOD)] == numbers


def test_a_full_counter_that_comes_after_the_next_sample_places_the_waiting_frames_too():
    found = at(900)
    for number in (999, 1000, 1001):
        found.wait(waiting(number), number * PERIOD)
    assert [number for number, _ in found.place(1000, 1001 * PERIOD)] == [999, 1000, 1001]


@pytest.mark.parametrize("lost", range(14))
def test_of_waiting_frames_so_many_may_be_lost_as_the_count_tells_apart(lost):
    found = at(900)
    for number in (1000, 1001 + lost):
        found.wait(waiting(number), number * PERIOD)
    assert [number for number, _ in found.place(1001 + lost, (1001 + lost) * PERIOD)] == [1000, 1001 + lost]


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
        assert ahead == 1 and found.accept(None, ahead) == number
    assert found.lost == 0


@pytest.mark.parametrize("lost", [1, 3])
def test_samples_lost_before_frames_without_a_count_are_found_after_eight_frames(lost):
    found = sequence(0, 0)
    number = 0
    for k in range(100):
        taken = k if k < 50 else k + lost
        number = found.accept(None, found.ahead(None, taken * PERIOD))
        if not 50 <= k < 57:
            assert number == taken
    assert found.lost == lost
