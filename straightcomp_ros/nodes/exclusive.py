"""Keeps other programs off the CPUs of a node, as far as its user may move them, for as long as the node lives.

A kernel that finishes its own work first lets no thread of whatever priority in while it writes another program's data:
only another CPU for that program helps. This file also runs as a process of its own, which needs nothing but Python and
ends when its standard input does: a killed node leaves nothing behind either.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from pathlib import Path

_NAME = "straightcomp_ros/exclusive/"
"""Of an abstract socket for each CPU that is kept free: it is gone with the process that has it."""
_PROCESSES = Path("/proc")
_SOCKETS = Path("/proc/net/unix")
_WORK_QUEUES = Path("/sys/devices/virtual/workqueue/cpumask")
_KEPT = "kept"
_TURN_S, _WAIT_S = 1.0, 0.01
_REAL_TIME = (os.SCHED_FIFO, os.SCHED_RR, 6)
"""With SCHED_DEADLINE, which Python has no name for."""

_held: list[subprocess.Popen[str]] = []


def keep_others_off(cpus: set[int]) -> str:
    """Let no other program run on these CPUs while this process lives, but one that may run nowhere else.

    Returns:
        What was done, in words.

    Raises:
        OSError: not possible; the message says why.
    """
    # A session of its own: an interrupt from the terminal is for the nodes.
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", __file__, *map(str, sorted(cpus))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    said = process.stdout.readline().strip()
    if not said.startswith(_KEPT):
        raise OSError(said or f"its process ended with exit code {process.wait()}")
    _held.append(process)
    return said


def kept_free() -> set[int]:
    """The CPUs that are kept free now. Who starts meanwhile does not inherit them, and may use them all the same."""
    try:
        names = [line.rpartition(" ")[2] for line in _SOCKETS.read_text().splitlines()]
    except OSError:
        return set()
    return {int(name.rpartition("/")[2]) for name in names if name.startswith("@" + _NAME)}


def _serve(cpus: set[int]) -> str:
    """Keep others off until standard input ends; returns why that is not possible, or nothing."""
    # The node that started this may use no other; the system leaves out what is not there or not permitted.
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    rest = os.sched_getaffinity(0) - cpus
    if not rest:
        return "there is no other CPU"
    os.sched_setaffinity(0, rest)
    claims = [_claim(cpu) for cpu in sorted(cpus)]
    if not all(claims):
        return "another node has them to itself"
    affinities = dict(_others())
    queues = _keep_queues_off(cpus)
    moved, refused = _move(lambda affinity: affinity - cpus)
    names = ", ".join(map(str, sorted(cpus)))
    left = f"; {refused} threads belong to other users and stay" if refused else ""
    print(f"{_KEPT} {moved} threads of other programs off CPU {names}{left}", flush=True)
    # Started with the node's priority, which was for this only.
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with suppress(KeyboardInterrupt):
        while os.read(sys.stdin.fileno(), 1):
            pass
    if queues:
        _WORK_QUEUES.write_text(queues)
    kept_before = {thread for thread, affinity in affinities.items() if not affinity & cpus}
    # Those that began meanwhile have inherited it.
    _move(lambda affinity: affinity | cpus, without=kept_before)
    return ""


def _claim(cpu: int) -> socket.socket | None:
    """Be the one that keeps this CPU free; none if another process is, for longer than one of a killed node takes."""
    claim = socket.socket(socket.AF_UNIX)
    deadline = time.monotonic() + _TURN_S
    while True:
        try:
            claim.bind(f"\0{_NAME}{cpu}")
        except OSError:
            if time.monotonic() > deadline:
                return None
            time.sleep(_WAIT_S)
        else:
            return claim


def _others() -> Iterator[tuple[int, set[int]]]:
    """Threads of normal priority, with the CPUs that they may use."""
    for task in _PROCESSES.glob("[0-9]*/task/[0-9]*"):
        thread = int(task.name)
        # It may have ended meanwhile.
        with suppress(OSError):
            if os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK not in _REAL_TIME:
                yield thread, os.sched_getaffinity(thread)


def _move(to: Callable[[set[int]], set[int]], without: Collection[int] = ()) -> tuple[int, int]:
    """Set affinities, where it leaves a CPU; again, until none began meanwhile with that of its parent.

    Returns:
        Number of threads moved, and of those that this user may not move.
    """
    moved: set[int] = set()
    refused: set[int] = set()
    while True:
        before = len(moved)
        for thread, affinity in _others():
            wanted = to(affinity)
            if wanted and wanted != affinity and thread not in without and thread not in refused:
                try:
                    os.sched_setaffinity(thread, wanted)
                    moved.add(thread)
                except PermissionError:
                    refused.add(thread)
                except OSError:
                    # A thread of the kernel that serves one CPU, or one that has ended.
                    pass
        if len(moved) == before:
            return len(moved), len(refused)


def _keep_queues_off(cpus: set[int]) -> str:
    """Let the kernel do its own writing on the other CPUs; returns the mask before, or nothing if it may not be set."""
    with suppress(OSError, ValueError):
        before = _WORK_QUEUES.read_text().strip()
        mask = int(before.replace(",", ""), 16) & ~sum(1 << cpu for cpu in cpus)
        if mask:
            _WORK_QUEUES.write_text(f"{mask:x}")
            return before
    return ""


def _main(words: list[str]) -> int:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    refusal = _serve({int(cpu) for cpu in words})
    if refusal:
        print(refusal)
    return 1 if refusal else 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
