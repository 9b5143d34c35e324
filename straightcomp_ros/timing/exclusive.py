"""Keeps other programs off a node's CPUs while the node lives, as far as its user may move them.

While a kernel without preemption writes another program's data on a CPU, it runs no thread there, whatever its
priority: only moving that program to another CPU helps. This file also runs as a separate process, which needs
only Python. It ends with its standard input, so a killed node leaves nothing behind. If it is killed together with the
node (a whole service or container), a file with the previous state remains, and the next process restores that state.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from pathlib import Path

_NAME = "straightcomp_ros/exclusive/"
"""Name of an abstract socket for each CPU that is kept free; the socket disappears with its process."""
_NOTES = Path(tempfile.gettempdir())
_BOOT = Path("/proc/sys/kernel/random/boot_id")
_PROCESSES = Path("/proc")
_SOCKETS = Path("/proc/net/unix")
_WORK_QUEUES = Path("/sys/devices/virtual/workqueue/cpumask")
_KEPT = "kept"
_TURN_S, _WAIT_S = 1.0, 0.01
_REAL_TIME = (os.SCHED_FIFO, os.SCHED_RR, 6)
"""6 is SCHED_DEADLINE, for which Python has no name."""

_held: list[subprocess.Popen[str]] = []


def keep_others_off(cpus: set[int]) -> str:
    """While this process lives, let no other program run on these CPUs unless it may run nowhere else.

    Returns what was done, in words; raises OSError with the reason if it is not possible.
    """
    # A separate session: an interrupt from the terminal is for the nodes only.
    command = [sys.executable, "-I", "-S", __file__, *map(str, sorted(cpus))]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    said = process.stdout.readline().strip()
    if not said.startswith(_KEPT):
        raise OSError(said or f"its process ended with exit code {process.wait()}")
    _held.append(process)
    return said


def kept_free() -> set[int]:
    """The CPUs that are kept free now. A node started meanwhile does not inherit them, but may use them."""
    with suppress(OSError):
        names = [line.rpartition(" ")[2] for line in _SOCKETS.read_text().splitlines()]
        return {int(name.rpartition("/")[2]) for name in names if name.startswith("@" + _NAME)}
    return set()


def left_behind() -> set[int]:
    """The CPUs that other programs still avoid because the process that kept them off was killed. The next node of the
    same user that calls :func:`keep_others_off` for them releases them when it ends."""
    noted: set[int] = set()
    for note in _NOTES.glob(_note_name("*", "*")):
        # Other users may write to that folder too.
        with suppress(OSError, ValueError):
            if note.lstat().st_uid in (0, os.getuid()):
                noted |= set(map(int, note.stem.rpartition("_")[2].split("-")))
    return noted & set(range(os.cpu_count() or 1)) - kept_free()


def _note_name(user: object, cpus: str) -> str:
    boot = ""
    with suppress(OSError):
        # After a reboot every program may run on every CPU again.
        boot = _BOOT.read_text().strip()
    return f"straightcomp_exclusive_{boot}_{user}_{cpus}.json"


class _Note:
    """The state before others were kept off these CPUs, in a file of this user that survives a kill."""

    def __init__(self, cpus: set[int]) -> None:
        self._file = _NOTES / _note_name(os.getuid(), "-".join(map(str, sorted(cpus))))

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


def _serve(cpus: set[int]) -> None:
    """Keep others off until standard input ends; raise OSError if that is not possible."""
    # This process inherited the node's CPUs; the system ignores CPUs that are missing or not permitted.
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    rest = os.sched_getaffinity(0) - cpus
    if not rest:
        raise OSError("there is no other CPU")
    os.sched_setaffinity(0, rest)
    claims = [_claim(cpu) for cpu in sorted(cpus)]
    if not all(claims):
        raise OSError("another node keeps them free for itself")
    note = _Note(cpus)
    elsewhere, queues = note.read() or ({thread for thread, allowed in _others() if not allowed & cpus}, _queues())
    note.write(elsewhere, queues)
    _keep_queues_off(cpus)
    moved, refused = _move(lambda affinity: affinity - cpus)
    names = ", ".join(map(str, sorted(cpus)))
    left = f"; {refused} threads belong to other users and stay" if refused else ""
    print(f"{_KEPT} {moved} threads of other programs off CPU {names}{left}", flush=True)
    # The node's priority, which this process inherited, is needed only up to here.
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with suppress(KeyboardInterrupt):
        while os.read(sys.stdin.fileno(), 1):
            pass
    with suppress(OSError):
        _WORK_QUEUES.write_text(queues)
    # Threads started meanwhile have inherited the smaller set.
    _move(lambda affinity: affinity | cpus, without=elsewhere)
    note.remove()


def _claim(cpu: int) -> socket.socket | None:
    """Claim this CPU; None if another process keeps it for longer than a killed node's process takes to end."""
    claim = socket.socket(socket.AF_UNIX)
    deadline = time.monotonic() + _TURN_S
    while time.monotonic() <= deadline:
        with suppress(OSError):
            claim.bind(f"\0{_NAME}{cpu}")
            return claim
        time.sleep(_WAIT_S)
    return None


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


def _main(words: list[str]) -> int:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        _serve({int(cpu) for cpu in words})
    except OSError as refusal:
        print(refusal)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
