"""Which CPUs a process uses: a loop has one, long work leaves those of all loops, other programs can be kept off.

Processes see each other's choices by claimed names: abstract sockets, which all users see and which a killed process
releases. A container with a network of its own sees only its own claims. All users may claim any name: one of another
form is passed over.
"""

import hashlib
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Set
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from straightcomp_ros.timing import cpu_guard

_SOCKETS = Path("/proc/net/unix")
_WAIT_S = 0.01
_LOOPS = "straightcomp_ros/loop/"
"""Each process of a graph claims the CPU of the graph's loop, followed by /mark of the graph/process id: a node that is
started again finds the others of its graph where it left them."""
_CHOICE = "straightcomp_ros/choice"
"""Claimed while a process chooses, so that two graphs which start together see each other."""
_KEPT = "straightcomp_ros/exclusive/"
"""Claimed by the guard for each CPU that it keeps free."""
_CLAIM = re.compile(r"[0-9]{1,4}(/\w{1,16}/[0-9]+)?", re.ASCII)
"""What follows the prefix in a name: a CPU, of a loop also whose it is."""
_TURN_S = 1.0
"""Longest wait for another process that chooses, or for the guard of a killed node to end."""

_held: list[socket.socket | subprocess.Popen[str]] = []
"""Claims and guards of this process."""
_ended: set[str] = set()
"""Marks of graphs whose loops have ended for this process."""


def claim(name: str, within: float = 0.0) -> socket.socket | None:
    """Claim ``name`` until the returned socket is closed; None if another process keeps it longer than ``within`` s."""
    mine = socket.socket(socket.AF_UNIX)
    deadline = time.monotonic() + within
    while True:
        with suppress(OSError):
            mine.bind(f"\0{name}")
            return mine
        if time.monotonic() >= deadline:
            mine.close()
            return None
        time.sleep(_WAIT_S)


def claimed(prefix: str) -> list[str]:
    """What follows ``prefix`` in the names that are claimed now and begin with it, where it is of our form."""
    with suppress(OSError):
        names = [line.partition("@")[2] for line in _SOCKETS.read_text(errors="replace").splitlines()]
        found = [name.removeprefix(prefix) for name in names if name.startswith(prefix)]
        return [each for each in found if _CLAIM.fullmatch(each)]
    return []


def loop_cpu(graph: str, permitted: Set[int]) -> int:
    """Claim a CPU of the ``permitted`` for the loop of ``graph`` while this process lives, and return it.

    It is the CPU that a process of this graph has claimed already; otherwise, of those with the fewest other loops,
    the last. OSError: other processes have been choosing for a second, or the system has no abstract sockets.
    """
    mark = hashlib.blake2b(graph.encode(), digest_size=8).hexdigest()
    choice = claim(_CHOICE, _TURN_S)
    if choice is None:
        raise OSError("other processes are choosing theirs")
    with choice:
        claims = _loop_claims()
        own = {cpu for cpu, owner in claims if owner == mark} & permitted
        loops = [cpu for cpu, _ in {one for one in claims if one[1] != mark}]
        cpu = max(own or permitted, key=lambda each: (-loops.count(each), each))
        # The same process may ask again.
        if mine := claim(f"{_LOOPS}{cpu}/{mark}/{os.getpid()}"):
            _held.append(mine)
    return cpu


def loop_cpus() -> set[int]:
    """The CPUs on which loops run now, of all graphs."""
    return {cpu for cpu, _ in _loop_claims()}


def end_loop() -> None:
    """The loop of this process's graph ends with this process: what is left to do here may use its CPU."""
    _ended.update(one.getsockname().decode().split("/")[3] for one in _held if isinstance(one, socket.socket))


def _loop_claims() -> list[tuple[int, str]]:
    claims = [name.split("/") for name in claimed(_LOOPS)]
    return [(int(claim[0]), claim[1]) for claim in claims if len(claim) > 1 and claim[1] not in _ended]


@contextmanager
def at_normal_priority() -> Iterator[None]:
    """Run the block in this thread at normal priority and, where there is another CPU, off those of all loops.

    For work that may take long: at a real-time priority it would stop every loop on its CPU, also of another graph.
    """
    policy, priority, cpus = os.sched_getscheduler(0), os.sched_getparam(0), os.sched_getaffinity(0)
    give_up_priority()
    try:
        yield
    finally:
        os.sched_setaffinity(0, cpus)
        os.sched_setscheduler(0, policy, priority)


def give_up_priority() -> None:
    """As :func:`at_normal_priority`, for good."""
    # The second is refused where only a loop's CPU is permitted.
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, set(range(os.cpu_count() or 1)) - loop_cpus())


def keep_others_off(cpus: Set[int]) -> str:
    """While this process lives, let no other program run on these CPUs unless it may run nowhere else.

    While a kernel without preemption writes another program's data on a CPU, it runs no thread there, whatever its
    priority: only moving that program helps. Returns what was done, in words; OSError with the reason if it cannot be.
    """
    with ExitStack() as claims:
        kept = [claims.enter_context(one) for cpu in sorted(cpus) if (one := claim(f"{_KEPT}{cpu}", _TURN_S))]
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
                pass_fds=[one.fileno() for one in kept],
            )
    assert process.stdout is not None
    first = process.stdout.readline().strip()
    if not first.startswith(cpu_guard.KEPT):
        raise OSError(first or f"its process ended with exit code {process.wait()}")
    _held.append(process)
    return first


def kept_free() -> set[int]:
    """The CPUs that are kept free now. A node started meanwhile does not inherit them, but may use them."""
    return {int(name) for name in claimed(_KEPT) if name.isdecimal()}


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
