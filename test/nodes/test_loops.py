"""The loops and the worker thread, without a graph."""

import itertools
import random
import threading
import time

import pytest
from rclpy.serialization import serialize_message

from straightcomp_ros.model.motion import Waypoint
from straightcomp_ros.runtime.graph_client import message_from_waypoints
from straightcomp_ros.runtime.loops import (
    IDLE_EVERY_NS,
    MessageLoop,
    PeriodicLoop,
    WorkerThread,
    awaited,
    now_ns,
    sendings,
)
from straightcomp_ros.runtime.runner import idle_turns
from straightcomp_ros.runtime.trajectory_action import read_by_stamp

PERIOD = 500_000


class Clock:
    """A simulated clock on which to sleep takes longer than asked, by ``late()`` ns, and each look some time."""

    def __init__(self, monkeypatch, late):
        self.now, self._late = 0, late
        monkeypatch.setattr(time, "monotonic_ns", self.look)
        monkeypatch.setattr(time, "sleep", self.sleep)

    def look(self):
        self.now += 100
        return self.now

    def sleep(self, seconds):
        self.now += round(seconds * 1e9) + self._late()


def lateness(monkeypatch, late, cycles=4000, **options):
    """How late in ns each of the later cycles began."""
    clock, begins = Clock(monkeypatch, late), []
    loop = PeriodicLoop(PERIOD, lambda wake_ns: begins.append(clock.now - wake_ns), **options)
    loop.run(lambda: len(begins) >= cycles, idle=lambda: None)
    assert min(begins) >= 0 and loop.missed.overruns == 0
    return sorted(begins[cycles // 2 :])


def test_idle_work_waits_where_a_cycle_was_late_but_not_for_ever(monkeypatch):
    clock, idle, cycles = Clock(monkeypatch, lambda: 0), [], []

    def cycle(wake_ns):
        # In the second half every cycle takes most of its period.
        clock.now += 400_000 if len(cycles) % 3 == 0 or len(cycles) > 300 else 100_000
        cycles.append(wake_ns)

    loop = PeriodicLoop(PERIOD, cycle)
    loop.run(lambda: len(cycles) >= 600, idle=lambda: idle.append((len(cycles) - 1, clock.now - cycles[-1])))
    relaxed = [left for number, left in idle if number <= 300]
    assert len(relaxed) > 20 and max(relaxed) <= PERIOD // 2
    turns = [number for number, _ in idle if number > 300]
    assert len(turns) >= 10
    assert all(later - sooner <= 2 * IDLE_EVERY_NS // PERIOD for sooner, later in itertools.pairwise(turns))


def test_the_loop_works_once_in_a_period_and_of_those_it_missed_the_late_wake_ups_are_the_hosts(monkeypatch):
    clock, begins = Clock(monkeypatch, lambda: 1_200_000 if len(begins) % 10 == 0 else 0), []

    def cycle(wake_ns):
        begins.append(clock.now - wake_ns)
        clock.now += 1_200_000 if len(begins) % 10 == 6 else 100_000

    loop = PeriodicLoop(PERIOD, cycle)
    loop.run(lambda: len(begins) >= 1000, idle=lambda: None)
    # The first cycle is due at once.
    assert (loop.missed.overruns, loop.missed.stalls) == (100, 99)
    # What was missed is not caught up: but for the late wake-ups each cycle begins in its own period.
    assert max(begin for number, begin in enumerate(begins) if number % 10) < PERIOD


def test_a_punctual_loop_begins_when_it_is_due_or_waits_for_an_eighth_of_a_period(monkeypatch):
    source = random.Random(3)

    def late():
        return source.randrange(30_000, 60_000)

    assert lateness(monkeypatch, late)[0] >= 30_000
    punctual = lateness(monkeypatch, late, punctual=True)
    # Half of the wake-ups are early enough, the others as much later as they differ.
    assert punctual[len(punctual) // 2 - 50] < 1000 and punctual[-1] < 20_000
    assert lateness(monkeypatch, lambda: 200_000, punctual=True)[0] >= 200_000 - PERIOD // 8
    assert lateness(monkeypatch, lambda: 0, punctual=True)[-1] < 1000


class Stream:
    """Messages at given times in ns from now, and a loop that waits for them; time is simulated."""

    def __init__(self, monkeypatch, arrivals):
        self.now, self.arrivals, self.cycles, self.idle = 0, list(arrivals), [], 0
        monkeypatch.setattr(time, "monotonic_ns", lambda: self.now)
        self.loop = MessageLoop(PERIOD, self.wait, self.cycle)

    def wait(self, timeout_ns):
        due = self.arrivals[0] if self.arrivals else self.now + timeout_ns
        self.now = max(self.now, min(due, self.now + timeout_ns)) + 20_000

    def cycle(self):
        came = [arrival for arrival in self.arrivals if arrival <= self.now]
        self.arrivals = self.arrivals[len(came) :]
        self.cycles.append(len(came))
        return len(came), self.now - came[-1] if came else 0

    def run(self, cycles):
        self.loop.run(lambda: len(self.cycles) >= cycles, lambda: setattr(self, "idle", self.idle + 1))


def test_a_loop_has_one_cycle_for_each_message_and_goes_on_without_any(monkeypatch):
    source = random.Random(2)
    jitter = [source.uniform(-30_000, 30_000) for _ in range(2000)]
    stream = Stream(monkeypatch, [round(1_000_000 + k * PERIOD * 1.0001 + jitter[k]) for k in range(2000)])
    stream.run(1900)
    assert set(stream.cycles) == {1} and stream.loop.missed.overruns == 0
    # Without messages it goes on with its idle work.
    stream = Stream(monkeypatch, [])
    stream.run(50)
    assert set(stream.cycles) == {0} and stream.idle >= 50
    assert stream.loop.report()["overruns"] == 0


def test_messages_found_together_are_overruns_and_the_next_one_is_due_a_period_after_the_last(monkeypatch):
    steady = [k * PERIOD for k in range(100)]
    # Ten that were held up come together; then the source is started anew, in another phase.
    held = [steady[-1] + 11 * PERIOD] * 10
    anew = [held[-1] + 700_000_000 + k * PERIOD for k in range(200)]
    stream = Stream(monkeypatch, steady + held + anew)
    stream.run(200 + len(steady))
    assert (stream.loop.missed.overruns, stream.loop.missed.stalls) == (0, 1) and max(stream.cycles) == 10
    arrival = stream.arrivals[0]
    assert stream.loop.turn() == (arrival + 20_000, PERIOD - 20_000)


def test_messages_that_a_late_source_sent_together_count_as_one():
    for sent, count in (
        ([], 0),
        ([100], 1),
        ([100, 120, 140], 3),  # periods apart by the source's clock: the receiver stood still
        ([140, 141, 142, 160], 2),  # the source stood still, and sent three at once; the next one is on time again
        ([140, 100, 120], 2),  # its clock was set back
    ):
        assert sendings(sent, 10) == count


def test_jobs_run_in_order_on_another_thread_and_one_that_fails_is_reported_and_stops_nothing():
    errors, done = [], []
    worker = WorkerThread(errors.append)

    def slow() -> None:
        time.sleep(0.05)
        done.append(threading.get_ident())

    for job in (slow, lambda: 1 / 0, lambda: done.append("last")):
        worker.run(job)
    worker.close()
    assert done[1:] == ["last"] and done[0] != threading.get_ident()
    assert len(errors) == 1 and "ZeroDivisionError" in errors[0]


def test_the_loop_goes_on_while_it_waits_for_a_result_and_gets_what_the_job_raised():
    turns, may_end, before = [], threading.Event(), threading.active_count()

    def meanwhile():
        turns.append(threading.get_ident())
        if len(turns) == 3:
            may_end.set()
        time.sleep(0.001)

    assert awaited(lambda: may_end.wait(60.0), meanwhile)
    assert len(turns) >= 3 and set(turns) == {threading.get_ident()}
    with pytest.raises(ZeroDivisionError):
        awaited(lambda: 1 // 0, meanwhile)
    # Threads that stayed would look like a leak to whoever watches a node for months.
    assert threading.active_count() == before


def test_requests_have_a_turn_of_idle_work_after_three_timers_even_where_these_are_always_due():
    turns = []
    timers = iter([True, True, True, True, False, True])
    idle = idle_turns(lambda: bool(turns.append("timer")) or next(timers), lambda: turns.append("request"))
    for _ in range(7):
        idle()
    # In the sixth turn no timer was due.
    assert turns == ["timer"] * 3 + ["request", "timer", "timer", "request", "timer"]


@pytest.mark.parametrize("step_s", [-100, 0, 100])
def test_a_trajectory_with_a_stamp_of_now_begins_now_also_after_a_step_of_the_system_s_clock(monkeypatch, step_s):
    system_ns = now_ns() + step_s * 10**9
    monkeypatch.setattr(time, "time_ns", lambda: system_ns)
    message = message_from_waypoints([Waypoint(0, 0.0, 0.0), Waypoint(10**9, 0.1, 0.0)])
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(system_ns, 10**9)
    assert read_by_stamp(serialize_message(message)).times.tolist() == [0, 10**9]
