"""The guard: a process of its own that keeps other programs off some CPUs until its standard input ends.

It runs this file alone and needs only Python. A node that is killed closes that input, so it leaves nothing behind. If
the guard is killed together with its node (a whole service or container), a file with the previous state remains, and
the next guard restores that state.
"""

import json
import os
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


class Note:
    """The state before others were kept off these CPUs, in a file of this user that survives a kill."""

    def __init__(self, cpus: set[int]) -> None:
        self._file = NOTES / note_name(os.getuid(), "-".join(map(str, sorted(cpus))))

    def read(self) -> tuple[set[int], str] | None:
        """Threads that did not use the CPUs, and the mask of the kernel's work queues; None without a file."""
        with suppress(OSError, ValueError, TypeError):
            if self._file.lstat().st_uid == os.getuid():
                threads, queues = json.loads(self._file.read_text())
                return set(map(int, threads)), str(queues)
        return None

    def write(self, threads: Collection[int], queues: str) -> None:
        """Keep both until :meth:`remove`."""
        self.remove()
        with suppress(OSError), open(self._file, "x", opener=lambda path, flags: os.open(path, flags, 0o600)) as file:
            json.dump([sorted(threads), queues], file)

    def remove(self) -> None:
        """Delete the file."""
        with suppress(OSError):
            self._file.unlink()


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
    note = Note(cpus)
    elsewhere, queues = note.read() or ({thread for thread, allowed in _others() if not allowed & cpus}, _queues())
    note.write(elsewhere, queues)
    _keep_queues_off(cpus)
    moved, refused = _move(lambda affinity: affinity - cpus)
    names = ", ".join(map(str, sorted(cpus)))
    left = f"; {refused} threads belong to other users and stay" if refused else ""
    print(f"{KEPT} {moved} threads of other programs off CPU {names}{left}", flush=True)
    with suppress(KeyboardInterrupt):
        while os.read(sys.stdin.fileno(), 1):
            pass
    _give_queues_back(cpus, queues)
    # Threads started meanwhile have inherited the smaller set.
    _move(lambda affinity: affinity | cpus, without=elsewhere)
    note.remove()


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


def _keep_queues_off(cpus: set[int]) -> None:
    """Let the kernel do its own work on the other CPUs, if this user may set that."""
    with suppress(OSError, ValueError):
        mask = int(_queues().replace(",", ""), 16) & ~sum(1 << cpu for cpu in cpus)
        if mask:
            _WORK_QUEUES.write_text(f"{mask:x}")


def _give_queues_back(cpus: set[int], before: str) -> None:
    """Let the kernel work on ``cpus`` again as ``before``; another graph's guard may have taken other CPUs since."""
    with suppress(OSError, ValueError):
        own = sum(1 << cpu for cpu in cpus)
        mask = int(_queues().replace(",", ""), 16) | int(before.replace(",", ""), 16) & own
        _WORK_QUEUES.write_text(f"{mask:x}")


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
