"""Time for which a process was ready to run but got no CPU, as Linux's scheduler counts it for each thread.

The count (the second number in ``/proc/PID/task/TID/schedstat``) grows while a thread waits in a run queue. It does not
contain the time that a hypervisor takes from the whole machine.
"""

import contextlib
import os
from pathlib import Path
from typing import BinaryIO


class CpuWait:
    """The longest wait of any thread of this process between two calls of :meth:`look`.

    Short waits between two calls add up: call often to tell one long wait from many short ones.

    Args:
        threads: folder with a folder for each thread; if it does not exist, no wait is reported.
    """

    def __init__(self, threads: Path = Path("/proc/self/task")) -> None:
        self._threads = threads
        self._files: dict[str, BinaryIO] = {}
        self._waited_ns: dict[str, int] = {}
        self._longest_ns = 0

    def look(self) -> None:
        """Read how long each thread has waited since the last look."""
        for thread, file in list(self._files.items()):
            try:
                waited_ns = int(os.pread(file.fileno(), 100, 0).split()[1])
            except (OSError, IndexError, ValueError):
                # The thread has ended.
                self._files.pop(thread).close()
                self._waited_ns.pop(thread, None)
                continue
            self._longest_ns = max(self._longest_ns, waited_ns - self._waited_ns.get(thread, waited_ns))
            self._waited_ns[thread] = waited_ns

    def take_us(self) -> float:
        """The longest wait since the last call, in µs; threads started since then are included from now on."""
        with contextlib.suppress(OSError):
            for thread in set(os.listdir(self._threads)) - set(self._files):
                with contextlib.suppress(OSError):
                    self._files[thread] = (self._threads / thread / "schedstat").open("rb")
        self.look()
        longest_ns, self._longest_ns = self._longest_ns, 0
        return longest_ns * 1e-3
