"""What a soak run left: processes that grew, and recordings with a gap."""

import os
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.recovery import default_output, recover
from straightcomp_ros.bench.graph_bench import usage
from straightcomp_ros.contract import ENCODER

MEMORY_SPAN_S = 600.0
"""Shortest time over which the slope of a process's memory is meaningful: a logger takes 5 MB in the first four minutes
of its work, and 6 to 8 MB in fifteen."""
MEMORY_LIMIT_MB_PER_HOUR = 60.0
HISTORIES_MB = 60.0
"""What a process may take once: the middleware keeps, for the lease of a killed recorder, the batches that it has not
acknowledged, and does not give their memory back. Driver, feedforward and controller in one process grew by 48 to 51 MB
in the first six kills of the recorder, and by 1 MB in the next eight."""
LONGEST_GAP_S = 0.6
"""Half a stroke: a stalled computer may lose so much of a recording."""
_OF_A_THREAD = "/schedstat"
"""A node's file that counts a thread's waits for a CPU: open from the report after the thread's start until the look
after its end, so that there may be one more or less of them than threads for a while."""


class Look(NamedTuple):
    """One process at one time: ns since the epoch, open descriptors without those of :data:`_OF_A_THREAD`, threads,
    resident memory in MB (10⁶ bytes)."""

    time_ns: int
    descriptors: int
    threads: int
    rss_mb: float


def look(process_id: int) -> Look:
    """Look now; OSError if the process has ended."""
    folder, files = f"/proc/{process_id}/fd", []
    for one in os.listdir(folder):
        with suppress(FileNotFoundError):  # closed since
            files.append(os.readlink(f"{folder}/{one}"))
    descriptors = sum(not file.endswith(_OF_A_THREAD) for file in files)
    threads = len(os.listdir(f"/proc/{process_id}/task"))
    return Look(time.time_ns(), descriptors, threads, usage({"": process_id}).rss_mb[""])


def grown(name: str, process_id: int, looks: Sequence[Look]) -> tuple[dict[str, Any], list[str]]:
    """Values of one process by name, at the first look and the last, and inadmissible growth, in words.

    A look may be taken while a killed peer and its successor are both known: such a peak of descriptors and threads is
    ignored unless it is in the last look.
    """
    first, last = looks[0], looks[-1]
    seconds, slope = (last.time_ns - first.time_ns) * 1e-9, None
    who = f"{name} (process {process_id}, {seconds:.0f} s)"
    counts = {what: (getattr(first, what), getattr(last, what)) for what in ("descriptors", "threads")}
    found = [f"{who} has {end} {what} after {begin}" for what, (begin, end) in counts.items() if end > begin]
    if seconds >= MEMORY_SPAN_S:
        hours = [(one.time_ns - first.time_ns) / 3.6e12 for one in looks]
        slope = float(np.polyfit(hours, [one.rss_mb for one in looks], 1)[0])
        if slope > MEMORY_LIMIT_MB_PER_HOUR and last.rss_mb - first.rss_mb > HISTORIES_MB:
            found.append(f"the memory of {who} grows by {slope:.0f} MB/h; allowed: {MEMORY_LIMIT_MB_PER_HOUR:g}")
    memory = {"rss_mb": (first.rss_mb, last.rss_mb), "slope_mb_per_hour": slope}
    return {"name": name, "seconds": seconds, **counts, **memory}, found


def missing_in_bags(folder: Path, recorded: Sequence[tuple[int, int]]) -> tuple[Counter[str], list[str]]:
    """How many of the bags of loggers in ``folder`` were finished, and recovered; and what they have not, in words, of
    the times that were known to be recorded, or why they cannot be read."""
    bags, stamps, failures = Counter[str](), [np.empty(0, np.int64)], []
    for bag in sorted(path for path in folder.glob("bag_*") if path.is_dir()):
        finished, whole = (bag / "metadata.yaml").exists(), bag
        try:
            if not finished:
                whole = default_output(bag)
                if not recover(bag, whole).saved:
                    raise BagError(f"bag {bag}: no message could be saved")
            streams = read_streams(whole, {ENCODER.topic: ENCODER.layout})
            stamps += [stream.stamp for stream in streams.values()]
            bags["finished" if finished else "recovered"] += 1
        except BagError as error:
            failures.append(str(error))
    if not recorded:
        failures.append("the recording was never known to be whole")
    for begin_ns, length_s in gaps(np.concatenate(stamps), recorded):
        failures.append(f"no bag has the {length_s:.1f} s from {begin_ns * 1e-9:.3f} s since the epoch on")
    return bags, failures


def gaps(stamps: NDArray[np.int64], recorded: Sequence[tuple[int, int]]) -> list[tuple[int, float]]:
    """Begin (ns) and length (s) of each longer time without a sample, while the recording was known to be complete."""
    found, stamps = [], np.unique(stamps)
    for begin, end in recorded:
        times = np.array([begin, *stamps[(stamps > begin) & (stamps < end)], end])
        lengths_s = np.diff(times) * 1e-9
        found += [(int(times[k]), float(lengths_s[k])) for k in np.flatnonzero(lengths_s > LONGEST_GAP_S)]
    return found
