"""Keeps a node from going deaf in shared memory, after another process died with the lock of its port in hand.

Fast DDS (2.14) then makes the port anew: whoever finds it broken removes its file by name, and the next to come
makes another. With several writers at work one of them may so remove the file that the reader has only just made.
The reader goes on waiting on a port that nobody can open any more, and would do so for good.

It can be seen, since the file that this process has mapped is no longer there; and it can be mended: a signal that
interrupts the reader's wait makes Fast DDS take the port for broken, and open again the one that has its name.
"""

from __future__ import annotations

import ctypes
import os
import re
import signal
from collections.abc import Callable
from pathlib import Path

from straightcomp_ros.nodes.threads import threads
from straightcomp_ros.shared_memory import held_by, mappings

_PROCESS = Path("/proc/self")
_PORT = re.compile(r"(fastrtps_port(\d+))_el")
_SIGNAL = signal.SIGURG
"""Ignored where nobody handles it, and used for urgent data on sockets only."""
PERIOD_S = 0.5
_PATIENCE = 2
"""Checks in a row that find a port's file gone; Fast DDS makes one anew within milliseconds where all goes well."""


class PortWatch:
    """Watches the ports on which this process reads now.

    A look costs some 10 µs. It belongs to the thread of the node's loop: a thread of its own would have a lower
    priority, and where other programs kept it from the CPU while it held the interpreter, the loop would wait for both.

    Args:
        tell: gets one sentence for each port whose reader was woken up.

    Raises:
        ValueError: not in the main thread, which alone may handle signals.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        # Other systems than Linux have no such files.
        names = held_by(os.getpid()) if _PROCESS.is_dir() else set()
        self._ports = [Port(match[1], int(match[2])) for match in map(_PORT.fullmatch, names) if match]
        # Python's handlers interrupt system calls.
        signal.signal(_SIGNAL, _do_nothing)
        # The first look reads all mappings of the process.
        self.look()

    def look(self) -> None:
        """Look once; to be called every :data:`PERIOD_S`."""
        for port in self._ports:
            if port.is_lost() and port.wake_reader():
                self._tell(
                    f"port {port.number} in shared memory was removed by others, as after a killed process: "
                    "opening it again"
                )


class Port:
    """A port that this process reads: the name of its file, and its number."""

    def __init__(self, name: str, number: int, folder: Path = Path("/dev/shm")) -> None:
        self.number = number
        self._file = folder / name
        self._ours: int | None = None
        self._lost = 0

    def is_lost(self) -> bool:
        """Whether the file that is mapped here has gone, and had gone at the last check."""
        if self._ours is None or self._found() != self._ours:
            # Reading the mappings takes a millisecond, looking at one file no time.
            self._ours = _mapped(self._file)
        self._lost = self._lost + 1 if self._ours is not None and self._found() != self._ours else 0
        return self._lost >= _PATIENCE

    def wake_reader(self) -> bool:
        """Interrupt the wait of the thread that reads the port; returns whether there is one."""
        readers = [thread for thread, name in threads().items() if name == f"dds.shm.{self.number}"]
        for reader in readers:
            _send(reader)
        return bool(readers)

    def _found(self) -> int | None:
        try:
            return self._file.stat().st_ino
        except OSError:
            return None


def _mapped(file: Path) -> int | None:
    """Inode of the newest of a file's mappings in this process, of a removed file too."""
    names = (str(file), f"{file} (deleted)")
    inodes = (inode for inode, path in mappings(_PROCESS) if str(path) in names)
    return max(inodes, default=None)


def _send(thread: int) -> None:
    ctypes.CDLL(None, use_errno=True).tgkill(os.getpid(), thread, int(_SIGNAL))


def _do_nothing(*_: object) -> None:
    pass
