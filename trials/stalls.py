"""Detects stalls of this computer: a thread on each CPU, scheduled like the nodes, that only sleeps and wakes up.

    python -m trials.stalls PRIORITY

prints each wake-up from a sleep of 2 ms that is late by 5 ms or more: CPU, time in ns since the epoch, lateness in ms.
Whatever delays it also delays a node on that CPU: a hypervisor, another program of the same priority, or a node of ours
that keeps the CPU for so long itself, which looks the same.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from pathlib import Path

_SLEEP_NS, _NOTED_NS = 2_000_000, 5_000_000


def total_ms(file: Path, begin_ns: int, end_ns: int) -> float:
    """Total stall time in ms by the watch that writes to ``file``, of all that overlap this time in ns since the epoch,
    of the CPU with most."""
    totals: dict[str, float] = {}
    # The last line may be incomplete.
    for line in file.read_text().rpartition("\n")[0].splitlines():
        cpu, time_ns, late = line.split()
        if int(time_ns) >= begin_ns and int(time_ns) - float(late) * 1e6 <= end_ns:
            totals[cpu] = totals.get(cpu, 0.0) + float(late)
    return max(totals.values(), default=0.0)


def _watch(cpu: int, priority: int) -> None:
    os.sched_setaffinity(0, {cpu})
    if priority:
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    before = time.monotonic_ns()
    while True:
        time.sleep(_SLEEP_NS * 1e-9)
        late_ns = time.monotonic_ns() - before - _SLEEP_NS
        if late_ns >= _NOTED_NS:
            print(f"{cpu} {time.time_ns()} {late_ns * 1e-6:.1f}\n", end="", flush=True)
        before = time.monotonic_ns()


if __name__ == "__main__":
    for one in os.sched_getaffinity(0):
        threading.Thread(target=_watch, args=(one, int(sys.argv[1])), daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt):
        signal.pause()
