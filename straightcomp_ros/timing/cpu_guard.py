"""The guard: a process of its own that keeps other programs off some CPUs until its standard input ends.

It runs this file alone and needs only Python. A node that is killed closes that input, so it leaves nothing behind. If
the guard is killed together with its node (a whole service or container), a file with the previous state remains, and
the next guard restores that state.
"""

import json
import os
import re
import signal
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from pathlib import Path

KEPT = "kept"
"""First word of the guard's output when it has begun; any other output is the reason why it could not."""
NOTES = Path(tempfile.gettempdir())
_BOOT = Path("/proc/sys/kernel/random/boot_id")
_PROCESSES = Path("/proc")
_WORK_QUEUES = Path("/sys/devices/virtual/workqueue/cpumask")
_REAL_TIME = (os.SCHED_FIFO, os.SCHED_RR, 6)
"""6 is SCHED_DEADLINE, for which Python has no name."""


def note_name(user: object, cpus: str) -> str:
    boot = ""
    with suppress(OSError):
        # After a reboot every program may run on every CPU again.
        boot = _BOOT.read_text().strip()
    return f"straightcomp_exclusive_{boot}_{user}_{cpus}.json"


def read_note(file: Path) -> tuple[set[int], str] | None:
    """The state before: threads that did not use the CPUs, and the mask of the kernel's work queues; None without."""
    with suppress(OSError, ValueError, TypeError):
        if file.lstat().st_uid == os.getuid():
            threads, queues = json.loads(file.read_text())
            return set(map(int, threads)), str(queues)
    return None


def write_note(file: Path, threads: Collection[int], queues: str) -> None:
    """Keep the state in a file that survives a kill."""
    with suppress(OSError):
        file.unlink(missing_ok=True)
        with open(file, "x", opener=lambda path, flags: os.open(path, flags, 0o600)) as output:
            json.dump([sorted(threads), queues], output)


def _serve(cpus: set[int], loops: set[int]) -> None:
    """Keep others off ``cpus`` until standard input ends, if a CPU that is not in ``loops`` is left; OSError if not."""
    # This process inherited the node's CPUs; the system ignores CPUs that are missing or not permitted.
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    rest = os.sched_getaffinity(0) - cpus
    if not rest:
        raise OSError("there is no other CPU")
    if rest <= loops:
        raise OSError("each other CPU has the loop of another graph")
    os.sched_setaffinity(0, rest)
    note = NOTES / note_name(os.getuid(), "-".join(map(str, sorted(cpus))))
    elsewhere, queues = read_note(note) or ({thread for thread, allowed in _others() if not allowed & cpus}, _queues())
    write_note(note, elsewhere, queues)
    _set_queues(cpus)
    moved, refused = _move(lambda affinity: affinity - cpus)
    names = ", ".join(map(str, sorted(cpus)))
    left = f"; {refused} threads belong to other users and stay" if refused else ""
    print(f"{KEPT} {moved} threads of other programs off CPU {names}{left}", flush=True)
    with suppress(KeyboardInterrupt):
        while os.read(sys.stdin.fileno(), 1):
            pass
    _set_queues(cpus, queues)
    # Threads started meanwhile have inherited the smaller set.
    _move(lambda affinity: affinity | cpus, without=elsewhere)
    with suppress(OSError):
        note.unlink()


def _others() -> Iterator[tuple[int, set[int]]]:
    """Threads of normal priority, with the CPUs that they may use."""
    for task in _PROCESSES.glob("[0-9]*/task/[0-9]*"):
        thread = int(task.name)
        # The thread may have ended.
        with suppress(OSError):
            if os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK not in _REAL_TIME:
                yield thread, os.sched_getaffinity(thread)


def _move(to: Callable[[set[int]], set[int]], without: Collection[int] = ()) -> tuple[int, int]:
    """Change the affinity of each thread that keeps a CPU; repeat until no new thread has inherited the old affinity.

    Returns the numbers of threads moved and of threads that this user may not move.
    """
    moved: set[int] = set()
    refused: set[int] = set()
    before = -1
    while len(moved) > before:
        before = len(moved)
        for thread, affinity in _others():
            wanted = to(affinity)
            if wanted and wanted != affinity and thread not in without and thread not in refused:
                # Other errors: the thread has ended, or is one of the kernel's that serves a single CPU.
                with suppress(OSError):
                    try:
                        os.sched_setaffinity(thread, wanted)
                        moved.add(thread)
                    except PermissionError:
                        refused.add(thread)
    return len(moved), len(refused)


def _queues() -> str:
    """The mask of the CPUs for the kernel's own work; empty if it cannot be read."""
    with suppress(OSError):
        return _WORK_QUEUES.read_text().strip()
    return ""


def _set_queues(cpus: set[int], before: str = "0") -> None:
    """Let the kernel do its own work on ``cpus`` as in the mask ``before``, if this user may set that.

    The other CPUs stay as they are: another graph's guard may have taken them.
    """
    with suppress(OSError, ValueError):
        own = sum(1 << cpu for cpu in cpus)
        if mask := int(_queues().replace(",", ""), 16) & ~own | int(before.replace(",", ""), 16) & own:
            # The kernel (bitmap_parse) wants a comma before each eight digits, counted from the end.
            _WORK_QUEUES.write_text(re.sub(r"(?<=.)(?=(.{8})+$)", ",", f"{mask:x}"))


def main(words: list[str]) -> int:
    """Serve; ``words`` are the CPUs to keep free and those of other loops, each separated by commas."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        _serve(*({int(cpu) for cpu in word.split(",") if cpu} for word in words))
    except OSError as refusal:
        print(refusal)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
