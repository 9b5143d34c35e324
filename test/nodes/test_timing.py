"""The periodic loop and its phase lock, without a graph."""

import itertools
import random
import time

from straightcomp_ros.nodes.periodic import PeriodicLoop
from straightcomp_ros.nodes.phase_lock import PhaseLock

PERIOD = 500_000


def locked(arrival_offset, start, jitter=0, drift=0.0, cycles=4000, target=50_000):
    """Wake-ups relative to arrivals, ns, of a loop whose messages come once in each period."""
    lock = PhaseLock(PERIOD, target)
    random_ = random.Random(1)
    wake = start
    waits = []
    arrivals = iter(
        round(arrival_offset + k * PERIOD * (1.0 + drift) + random_.uniform(0, jitter)) for k in range(10 * cycles)
    )
    newest = next(arrivals)
    upcoming = next(arrivals)
    for _ in range(cycles):
        while upcoming <= wake:
            newest, upcoming = upcoming, next(arrivals)
        waited = wake - newest
        waits.append(waited)
        wake += PERIOD + lock.shift_ns(waited)
    return waits


def test_from_every_phase_the_wake_up_settles_just_behind_the_arrival_within_half_a_second():
    for start in range(0, PERIOD, 37_000):
        waits = locked(arrival_offset=1_000_000, start=1_000_000 + PERIOD + start)
        assert all(abs(wait - 50_000) < 10_000 for wait in waits[1000:])


def test_clocks_that_differ_by_a_hundred_ppm_stay_locked():
    for drift in (1e-4, -1e-4):
        assert all(abs(wait - 50_000) < 10_000 for wait in locked(0, PERIOD, drift=drift)[1000:])


def test_with_jittering_arrivals_few_messages_are_missed():
    waits = locked(0, PERIOD, jitter=80_000)[1000:]
    assert sum(wait > 400_000 for wait in waits) < 0.1 * len(waits)


def test_the_loop_never_works_twice_in_a_period_and_counts_what_it_missed():
    wakes = []

    def cycle(wake_ns):
        wakes.append((wake_ns, time.monotonic_ns()))
        if len(wakes) == 5:
            time.sleep(0.0525)

    loop = PeriodicLoop(10_000_000, cycle)
    loop.run(lambda: len(wakes) >= 12, idle=lambda: None)
    scheduled = [wake for wake, _ in wakes]
    assert all(later - earlier >= 10_000_000 for earlier, later in itertools.pairwise(scheduled))
    assert all((wake - scheduled[0]) % 10_000_000 == 0 for wake in scheduled)
    assert loop.overruns >= 4 and loop.cycles == 12
    assert all(now >= wake for wake, now in wakes)


def test_a_shift_moves_all_later_wake_ups_once():
    wakes = []

    def cycle(wake_ns):
        wakes.append(wake_ns)
        if len(wakes) == 3:
            loop.shift(1_000_000)

    loop = PeriodicLoop(5_000_000, cycle)
    loop.run(lambda: len(wakes) >= 6, idle=lambda: None)
    # A stalled machine may miss whole periods in between.
    assert [(wake - wakes[0]) % 5_000_000 for wake in wakes] == [0, 0, 0, 1_000_000, 1_000_000, 1_000_000]
