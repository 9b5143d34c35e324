"""Keeps other programs off a node's CPUs while the node lives, as far as its user may move them.

While a kernel without preemption writes another program's data on a CPU, it runs no thread there, whatever its
priority: only moving that program to another CPU helps.
"""

import os
import subprocess
import sys
from collections.abc import Set
from contextlib import suppress

from straightcomp_ros.timing import cpu_guard
from straightcomp_ros.timing.claimed_names import claim, claimed
from straightcomp_ros.timing.loop_cpu import loop_cpus
from straightcomp_ros.timing.normal_priority import at_normal_priority

_NAME = "straightcomp_ros/exclusive/"
"""Claimed by the guard for each CPU that it keeps free."""
_TURN_S = 1.0
"""Longest time that the guard of a killed node takes to end."""

_held: list[subprocess.Popen[str]] = []


def keep_others_off(cpus: Set[int]) -> str:
    """While this process lives, let no other program run on these CPUs unless it may run nowhere else.

    Returns what was done, in words; raises OSError with the reason if it is not possible.
    """
    claims = [claim(f"{_NAME}{cpu}", _TURN_S) for cpu in sorted(cpus)]
    try:
        kept = [one.fileno() for one in claims if one is not None]
        if len(kept) < len(cpus):
            raise OSError("another node keeps them free for itself")
        words = [",".join(map(str, sorted(each))) for each in (cpus, loop_cpus() - cpus)]
        # The guard inherits the priority of this thread.
        with at_normal_priority():
            process = subprocess.Popen(
                [sys.executable, "-I", "-S", cpu_guard.__file__, *words],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                # An interrupt from the terminal is for the nodes only.
                start_new_session=True,
                # The claims live as long as the guard.
                pass_fds=kept,
            )
    finally:
        for one in claims:
            if one is not None:
                one.close()
    assert process.stdout is not None
    said = process.stdout.readline().strip()
    if not said.startswith(cpu_guard.KEPT):
        raise OSError(said or f"its process ended with exit code {process.wait()}")
    _held.append(process)
    return said


def kept_free() -> set[int]:
    """The CPUs that are kept free now. A node started meanwhile does not inherit them, but may use them."""
    return set(map(int, claimed(_NAME)))


def use_kept_free(used: bool) -> None:
    """Let this thread, and what it starts from now on, run on the CPUs that are kept free, or no longer.

    For a client of a graph whose loop is at rest while the client computes. Where there are other loops nothing
    changes, since theirs may be at work.
    """
    kept = kept_free()
    if used and len(loop_cpus()) > 1:
        return
    affinity = os.sched_getaffinity(0)
    wanted = affinity | kept if used else affinity - kept
    with suppress(OSError):
        os.sched_setaffinity(0, wanted or affinity)


def left_behind() -> set[int]:
    """The CPUs that other programs still avoid because the process that kept them off was killed. The next node of the
    same user that calls :func:`keep_others_off` for them releases them when it ends."""
    noted: set[int] = set()
    for note in cpu_guard.NOTES.glob(cpu_guard.note_name("*", "*")):
        # Other users may write to that folder too.
        with suppress(OSError, ValueError):
            if note.lstat().st_uid in (0, os.getuid()):
                noted |= set(map(int, note.stem.rpartition("_")[2].split("-")))
    return noted & set(range(os.cpu_count() or 1)) - kept_free()
