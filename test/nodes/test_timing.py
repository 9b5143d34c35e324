"""The loops and the phase lock, without a graph."""

import itertools
import random
import time

from straightcomp_ros.nodes.locked_loop import LockedLoop
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


class Stream:
    """Messages at given times in ns from now, and a loop that waits for them; time is simulated."""

    def __init__(self, monkeypatch, arrivals):
        self.now, self.arrivals, self.cycles, self.idle, self.errors = 0, list(arrivals), [], 0, []
        monkeypatch.setattr(time, "monotonic_ns", lambda: self.now)
        self.loop = LockedLoop(PERIOD, self.wait, self.cycle)

    def wait(self, timeout_ns):
        due = self.arrivals[0] if self.arrivals else self.now + timeout_ns
        self.now = max(self.now, min(due, self.now + timeout_ns)) + 20_000

    def cycle(self):
        came = [arrival for arrival in self.arrivals if arrival <= self.now]
        self.arrivals = self.arrivals[len(came) :]
        self.cycles.append(len(came))
        self.errors.append(self.loop.phase_error_ns)
        return len(came), self.now - came[-1] if came else 0

    def run(self, cycles):
        def idle():
            self.idle += 1

        self.loop.run(lambda: len(self.cycles) >= cycles, idle)


def test_a_locked_loop_has_one_cycle_for_each_message_and_says_how_steadily_they_come(monkeypatch):
    source = random.Random(2)
    jitter = [source.uniform(-30_000, 30_000) for _ in range(2000)]
    stream = Stream(monkeypatch, [round(1_000_000 + k * PERIOD * 1.0001 + jitter[k]) for k in range(2000)])
    stream.run(1900)
    assert set(stream.cycles) == {1} and stream.loop.overruns == 0
    settled = stream.errors[1000:]
    assert max(map(abs, settled)) < 70_000
    assert abs(sum(settled) / len(settled)) < 10_000


def test_messages_found_together_are_overruns_and_a_new_source_is_locked_to_at_once(monkeypatch):
    steady = [k * PERIOD for k in range(100)]
    # Ten that were held up come together; then the source is started anew, in another phase.
    held = [steady[-1] + 11 * PERIOD] * 10
    anew = [held[-1] + 700_000_000 + k * PERIOD for k in range(200)]
    stream = Stream(monkeypatch, steady + held + anew)
    stream.run(200 + len(steady))
    assert stream.loop.overruns == 9 and max(stream.cycles) == 10
    assert abs(stream.loop.phase_error_ns) < 1000


def test_without_messages_a_locked_loop_goes_on_with_its_idle_work(monkeypatch):
    stream = Stream(monkeypatch, [])
    stream.run(50)
    assert set(stream.cycles) == {0} and stream.idle == 50
    assert stream.loop.report()["overruns"] == 0
