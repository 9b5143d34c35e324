"""How long a process was ready to run and got no CPU, as Linux's scheduler counts it for each thread.

The count (the second number in ``/proc/PID/task/TID/schedstat``) grows while a thread waits in a run queue. What a
hypervisor takes from the whole machine is not in it.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import BinaryIO

_OWN_THREADS = Path("/proc/self/task")


class CpuWait:
    """The longest wait of any thread of this process, as seen from one look to the next.

    Short waits between two looks add up: to tell one long wait from many short ones, look often.

    Args:
        threads: folder with a folder for each thread; without it there is never a wait.
    """

    def __init__(self, threads: Path = _OWN_THREADS) -> None:
        self._threads = threads
        self._files: dict[str, BinaryIO] = {}
        """They are closed when this object goes, as with the part of a node that is released."""
        self._waited: dict[str, int] = {}
        self._longest_ns = 0

    def look(self) -> None:
        """See how long each thread has waited since the last look."""
        for thread, file in list(self._files.items()):
            try:
                waited_ns = int(os.pread(file.fileno(), 100, 0).split()[1])
            except (OSError, IndexError, ValueError):
                # The thread has ended.
                self._files.pop(thread).close()
                continue
            before_ns = self._waited.get(thread, waited_ns)
            self._longest_ns = max(self._longest_ns, waited_ns - before_ns)
            self._waited[thread] = waited_ns

    def take_us(self) -> float:
        """The longest wait since the last call, in µs; threads that have come since are looked at from now on."""
        with contextlib.suppress(OSError):
            for thread in os.listdir(self._threads):
                if thread not in self._files:
                    with contextlib.suppress(OSError):
                        self._files[thread] = (self._threads / thread / "schedstat").open("rb")
                        self._waited.pop(thread, None)
        self.look()
        longest_ns, self._longest_ns = self._longest_ns, 0
        return longest_ns * 1e-3

    def close(self) -> None:
        """Look no more."""
        while self._files:
            self._files.popitem()[1].close()
