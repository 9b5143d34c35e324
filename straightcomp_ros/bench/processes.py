"""CPU time and memory of other processes, from Linux's /proc."""

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")
_UTIME = 11
"""Index of the user time after the command's name in /proc/PID/stat (proc(5): field 14); the system time follows."""


@dataclass(frozen=True)
class Usage:
    """What processes have used up to one moment.

    Attributes:
        time_ns: the moment, ns since the epoch.
        cpu: seconds of CPU since the start of each, all threads, by name; known to 10 ms.
        rss_mb: resident memory of each in MB (10⁶ bytes), by name.
    """

    time_ns: int
    cpu: Mapping[str, float]
    rss_mb: Mapping[str, float]


def usage(process_ids: Mapping[str, int]) -> Usage:
    """Look now.

    Raises:
        OSError: a process has ended.
    """
    cpu, rss = {}, {}
    for name, pid in process_ids.items():
        # The command's name is in parentheses and may contain any character.
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        cpu[name] = (int(fields[_UTIME]) + int(fields[_UTIME + 1])) / _TICKS
        rss[name] = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE * 1e-6
    return Usage(time.time_ns(), cpu, rss)


def descriptors(process_id: int) -> int:
    """Open file descriptors of a process.

    Raises:
        OSError: it has ended.
    """
    return len(os.listdir(f"/proc/{process_id}/fd"))


def threads(process_id: int) -> int:
    """Threads of a process.

    Raises:
        OSError: it has ended.
    """
    return len(os.listdir(f"/proc/{process_id}/task"))


def cores(begin: Usage, end: Usage) -> dict[str, float]:
    """CPU cores that each process kept busy between two looks."""
    seconds = (end.time_ns - begin.time_ns) * 1e-9
    return {name: (end.cpu[name] - begin.cpu[name]) / seconds for name in begin.cpu}
