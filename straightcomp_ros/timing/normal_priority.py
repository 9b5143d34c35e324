"""Normal scheduling for work that may take long: at a real-time priority it would stop every loop on its CPU, also that
of another graph."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from straightcomp_ros.timing.loop_cpu import loop_cpus


@contextmanager
def at_normal_priority() -> Iterator[None]:
    """Run the block in this thread at normal priority and, where there is another CPU, off those of all loops."""
    policy, priority, cpus = os.sched_getscheduler(0), os.sched_getparam(0), os.sched_getaffinity(0)
    give_up_priority()
    try:
        yield
    finally:
        os.sched_setaffinity(0, cpus)
        os.sched_setscheduler(0, policy, priority)


def give_up_priority() -> None:
    """Let this thread have normal priority and, where there is another CPU, be off those of all loops."""
    # The second is refused where only a loop's CPU is permitted.
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, set(range(os.cpu_count() or 1)) - loop_cpus())
