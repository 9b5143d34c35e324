"""The loops on a process's main thread, their clock, and work in a worker thread in parallel with them. No ROS."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from queue import SimpleQueue
from typing import TypeVar

from straightcomp_ros.timing.delays import Histogram
from straightcomp_ros.timing.node_timing import TIMER_ERROR, MissedPeriods, written

_PR_SET_TIMERSLACK = 29
IDLE_EVERY_NS = 6_000_000
"""Interval between two turns of idle work, each short so that the next cycle is not late. A turn with less than half a
period left waits for the next period, but at most for one more interval."""
_EARLIER_NS = 50
"""Step by which the loop adapts to the machine's wake-up delay: at 2 kHz it covers 50 µs in half a second."""
_MOST_AWAKE_NS, _NAP_S = 2_000_000, 0.0001
"""A loop that is always late sleeps after each 2 ms: at a real-time priority it would keep those from running who send
its messages."""
_SWITCH_INTERVAL_S = 1e-4
"""Longest wait of the loop for the interpreter lock while the worker thread computes. Python's default of 5 ms is ten
sampling periods."""
_OFFSET_NS = time.time_ns() - time.monotonic_ns()

T = TypeVar("T")


def now_ns() -> int:
    """A clock that never steps, in ns since the epoch, since stamps must stay on the sampling grid: the monotonic
    clock, set to the system time once, when the process starts."""
    return from_monotonic(time.monotonic_ns())


def from_monotonic(monotonic_ns: int) -> int:
    """Convert a reading of ``time.monotonic_ns`` to :func:`now_ns`."""
    return monotonic_ns + _OFFSET_NS


class Loop(ABC):
    """What a node runs instead of an executor.

    Attributes:
        missed: periods without a cycle of their own.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self.missed = MissedPeriods(period_ns)
        self._lateness = Histogram()

    def run(self, stopped: Callable[[], bool], idle: Callable[[], None], idle_every_ns: int = IDLE_EVERY_NS) -> None:
        """Loop until ``stopped()``; ``idle`` is called every ``idle_every_ns``, for work that can wait: see
        :data:`IDLE_EVERY_NS`."""
        next_ns = time.monotonic_ns()
        enough_ns = self._period_ns // 2
        while not stopped():
            now_ns, left_ns = self.turn()
            late_ns = now_ns - next_ns
            if late_ns >= 0 and (left_ns >= enough_ns or late_ns >= idle_every_ns):
                # What waited for too long has two turns: otherwise there would be half as many.
                for _ in range(1 + (late_ns >= idle_every_ns)):
                    idle()
                next_ns = now_ns + idle_every_ns

    @abstractmethod
    def turn(self) -> tuple[int, int]:
        """Wait for one cycle and run it: what idle work calls while it waits for something. Returns the time of its
        cycle, and how long before the next one is due it has ended, in ns."""

    def report(self) -> dict[str, object]:
        """Values for the diagnostics: missed periods, and how late the cycles since the last report were."""
        return {**self.missed.report(), **written(TIMER_ERROR, self._lateness.take())}


class PeriodicLoop(Loop):
    """Calls ``cycle`` once in each period, at absolute wake-up times. After a stall it continues with the next period
    and counts the periods it missed; it never calls twice to catch up.

    ``cycle`` gets the monotonic time in ns at which the period was to start. A ``punctual`` loop wakes up early by this
    machine's usual delay and busy-waits for the rest; otherwise every answer would be late by a tenth of a period.
    """

    def __init__(self, period_ns: int, cycle: Callable[[int], object], punctual: bool = False) -> None:
        super().__init__(period_ns)
        self._most_early_ns = period_ns // 8 if punctual else 0
        self._due_ns = self._early_ns = self._slept_ns = self._woken_late_ns = 0
        self._cycle = cycle

    def run(self, stopped: Callable[[], bool], idle: Callable[[], None], idle_every_ns: int = IDLE_EVERY_NS) -> None:
        if sys.platform == "linux":
            # To save power, Linux wakes a normal thread up to 50 µs late: a tenth of our period.
            ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1)
        self._due_ns = time.monotonic_ns()
        super().run(stopped, idle, idle_every_ns)

    def turn(self) -> tuple[int, int]:
        monotonic_ns, wake_ns = time.monotonic_ns, self._due_ns
        behind_ns = monotonic_ns() - wake_ns
        if behind_ns > 0:
            periods = behind_ns // self._period_ns
            self.missed.count(periods, self._woken_late_ns)
            wake_ns += periods * self._period_ns
        wait_ns = wake_ns - self._early_ns - monotonic_ns()
        self._woken_late_ns = 0
        if wait_ns > 0:
            time.sleep(wait_ns * 1e-9)
            self._slept_ns = monotonic_ns()
            self._woken_late_ns = self._slept_ns - wake_ns
            self._follow(self._woken_late_ns + self._early_ns)
        elif wake_ns - self._slept_ns > _MOST_AWAKE_NS:
            time.sleep(_NAP_S)
            self._slept_ns = monotonic_ns()
        else:
            os.sched_yield()
        while monotonic_ns() < wake_ns:
            pass
        self._lateness.record(monotonic_ns() - wake_ns)
        self._cycle(wake_ns)
        self._due_ns = due_ns = wake_ns + self._period_ns
        return wake_ns, due_ns - monotonic_ns()

    def _follow(self, late_ns: int) -> None:
        """Adapt how early to wake up, so that half of all wake-ups are late."""
        step_ns = _EARLIER_NS if late_ns > self._early_ns else -_EARLIER_NS
        self._early_ns = min(max(0, self._early_ns + step_ns), self._most_early_ns)


class MessageLoop(Loop):
    """A cycle begins when a message arrives; without messages the loop only does its idle work.

    ``wait(timeout_ns)`` returns when a message has arrived, or after that time. ``cycle`` returns the number of
    messages found, where those sent together count as one, and the age of the newest in ns, by which it was late.

    Attributes:
        missed: messages without a cycle of their own, because a cycle found a later one too.
    """

    def __init__(self, period_ns: int, wait: Callable[[int], None], cycle: Callable[[], tuple[int, int]]) -> None:
        super().__init__(period_ns)
        self._wait, self._cycle = wait, cycle

    def turn(self) -> tuple[int, int]:
        self._wait(IDLE_EVERY_NS)
        woken_ns = time.monotonic_ns()
        count, age_ns = self._cycle()
        if count:
            self._lateness.record(age_ns)
            if count > 1:
                self.missed.count(count - 1)
                # At a real-time priority a loop that never waits would keep the middleware's threads from running.
                os.sched_yield()
        now_ns = time.monotonic_ns()
        # The next message is due a period after the last one; without one the idle work has the whole period.
        return now_ns, woken_ns - age_ns + self._period_ns - now_ns if count else self._period_ns


def sendings(sent_ns: Sequence[int], apart_ns: int) -> int:
    """The number of separate sends: a message less than ``apart_ns`` after its predecessor was sent together with it.

    A source that was late sends the messages it missed together. A receiver that gets them in one cycle was not late.
    ``sent_ns`` are the times at which the messages were sent, ascending.
    """
    return sum(later - sooner >= apart_ns for sooner, later in pairwise(sent_ns)) + bool(sent_ns)


def awaited(job: Callable[[], T], meanwhile: Callable[[], object]) -> T:
    """What ``job`` returns or raises, done once in a thread that ends with it; scheduling as of `WorkerThread`.

    ``meanwhile`` is called again and again until it is done.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    with ThreadPoolExecutor(max_workers=1) as thread:
        done = thread.submit(job)
        while not done.done():
            meanwhile()
        return done.result()


class WorkerThread:
    """Does jobs in a thread, in the order in which they came, so that the loop misses no cycle.

    The thread is started by the first job, in the loop's thread, so it inherits the loop's scheduling, unless
    :meth:`start` did before. With a lower priority on the same CPU it would be preempted while it holds the interpreter
    lock, and the loop would wait for both. ``failed`` is called with the reason when a job fails.
    """

    def __init__(self, failed: Callable[[str], object]) -> None:
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        self._failed = failed
        # An executor's futures take longer than most of the jobs.
        self._jobs: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def run(self, job: Callable[[], object]) -> None:
        """Queue ``job`` and return at once."""
        self.start()
        self._jobs.put(job)

    def start(self) -> None:
        """Start the thread, if it has not been."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, daemon=True)
            self._thread.start()

    def wait(self) -> None:
        """Wait for all jobs. Without one no thread is started: the caller may have another scheduling than the loop."""
        if self._thread is not None:
            done = threading.Event()
            self._jobs.put(done.set)
            done.wait()

    def close(self) -> None:
        """Wait for all jobs, and end the thread."""
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join()

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception as error:  # A job is the work of another file, and the thread must go on.
                self._failed(f"a job of the worker thread failed: {error!r}")
