"""CPU time and memory of other processes, from Linux's /proc."""

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")
_UTIME = 11
"""Index of the user time after the command's name in /proc/PID/stat (proc(5): field 14); the system time follows."""


class Usage(NamedTuple):
    """What processes have used up to one moment, by name."""

    time_ns: int  # since the epoch
    cpu: Mapping[str, float]  # seconds of CPU since the start of each, all threads; known to 10 ms
    rss_mb: Mapping[str, float]  # resident memory in MB (10⁶ bytes)


def usage(process_ids: Mapping[str, int]) -> Usage:
    """Look now; OSError if a process has ended."""
    cpu, rss = {}, {}
    for name, pid in process_ids.items():
        # The command's name is in parentheses and may contain any character.
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        cpu[name] = (int(fields[_UTIME]) + int(fields[_UTIME + 1])) / _TICKS
        rss[name] = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE * 1e-6
    return Usage(time.time_ns(), cpu, rss)


def cores(begin: Usage, end: Usage) -> dict[str, float]:
    """CPU cores that each process kept busy between two looks."""
    seconds = (end.time_ns - begin.time_ns) * 1e-9
    return {name: (end.cpu[name] - begin.cpu[name]) / seconds for name in begin.cpu}


def growth_mb_per_hour(looks: Sequence[Usage]) -> dict[str, float]:
    """Slope of each process's memory over all looks (least squares), MB/h; NaN with fewer than two."""
    if len(looks) < 2:
        return dict.fromkeys(looks[0].rss_mb, float("nan"))
    hours = [(look.time_ns - looks[0].time_ns) / 3.6e12 for look in looks]
    return {name: float(np.polyfit(hours, [look.rss_mb[name] for look in looks], 1)[0]) for name in looks[0].rss_mb}
