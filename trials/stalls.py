"""Detects stalls of this computer: a process on each CPU, scheduled like the nodes, that only sleeps and wakes up.

    python -m trials.stalls CPU PRIORITY

sleeps for 2 ms repeatedly, and prints each wake-up that is late by 5 ms or more: the time in ns since the epoch and the
lateness in ms. Whatever delays it also delays a node on that CPU: a hypervisor, another program of the same priority,
or a node of ours that keeps the CPU for so long itself, which looks the same.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

_SLEEP_NS, _NOTED_NS = 2_000_000, 5_000_000


class Stalls(contextlib.ExitStack):
    """The watches on all CPUs; they run while this context manager is open.

    Args:
        folder: for their output.
        priority: SCHED_FIFO priority, 0 for normal scheduling.
    """

    def __init__(self, folder: Path, priority: int) -> None:
        super().__init__()
        self.files = {cpu: folder / f"stalls_{cpu}.txt" for cpu in sorted(os.sched_getaffinity(0))}
        self.processes: list[subprocess.Popen[bytes]] = []
        self._priority = priority

    def __enter__(self) -> Stalls:
        for cpu, file in self.files.items():
            command = [sys.executable, "-m", "trials.stalls", str(cpu), str(self._priority)]
            with file.open("wb") as output:
                process = self.enter_context(subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output))
            self.callback(process.kill)
            self.processes.append(process)
        return self

    def total_ms(self, begin_ns: int, end_ns: int) -> float:
        """Total stall time in ms, of all that overlap this time in ns since the epoch, of the CPU with most."""
        return max(_total_ms(file, begin_ns, end_ns) for file in self.files.values())


def _total_ms(file: Path, begin_ns: int, end_ns: int) -> float:
    total = 0.0
    for line in file.read_text().splitlines():
        time_ns, _, late = line.partition(" ")
        # The last line may be incomplete.
        with contextlib.suppress(ValueError):
            if int(time_ns) >= begin_ns and int(time_ns) - float(late) * 1e6 <= end_ns:
                total += float(late)
    return total


def main() -> None:
    """Watch until killed, or until the parent process has ended."""
    cpu, priority = map(int, sys.argv[1:3])
    os.sched_setaffinity(0, {cpu})
    if priority:
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent, before = os.getppid(), time.monotonic_ns()
    while os.getppid() == parent:
        time.sleep(_SLEEP_NS * 1e-9)
        late_ns = time.monotonic_ns() - before - _SLEEP_NS
        if late_ns >= _NOTED_NS:
            print(time.time_ns(), f"{late_ns * 1e-6:.1f}", flush=True)
        before = time.monotonic_ns()


if __name__ == "__main__":
    main()
