"""Removes what killed processes left of Fast DDS in shared memory.

Fast DDS keeps in /dev/shm, for each participant, a segment ``fastrtps_<16 hexadecimal digits>`` with its messages and,
for each port that one listens on, ``fastrtps_port<number>`` with a semaphore ``sem.fastrtps_port<number>_mutex``.
Beside each stands a lock file, ``…_el`` (one owner) or ``…_sl`` (several), which the owners hold with flock(2) as long
as they live. So a lock file on which the exclusive lock can be had belongs to nobody: the rule by which
`fastdds shm clean` and Fast DDS itself tell the dead from the living (Fast DDS 2.14: RobustExclusiveLock.hpp,
RobustSharedLock.hpp, SharedMemGlobal.hpp, tools/fastdds/shm/clean.py).

A port without a lock file has no listener, but writers may still have it open; it stays, and does no harm: the next
listener takes it over.
"""

from __future__ import annotations

import fcntl
import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_FOLDER = Path("/dev/shm")
_OTHER = {"_el": "_sl", "_sl": "_el"}
_LOCK = re.compile(r"(fastrtps_(?:[0-9a-f]{16}|port\d{1,5}))_[es]l")
_YOUNG_S = 2.0
"""Fast DDS locks and maps a file a moment after making it."""
_PATIENCE_S = 1.0


def remove_stale(folder: Path = _FOLDER, young: float = _YOUNG_S) -> list[str]:
    """Remove this user's files of Fast DDS that no living process uses.

    Several processes that start at once clean one after the other. Where cleaning is not possible (another system,
    another user's cleaning takes long) nothing is removed, and no error raised.

    Args:
        folder: where the files are.
        young: files made less than so many seconds ago stay.

    Returns:
        Names of the files that were removed.
    """
    removed: list[str] = []
    if not sys.platform.startswith("linux") or not folder.is_dir():
        return removed
    with _alone(folder) as alone:
        if alone:
            for match in filter(None, map(_LOCK.fullmatch, sorted(os.listdir(folder)))):
                if _is_old_and_ours(folder / match[0], young):
                    removed += _removed_if_free(folder, match[0], match[1])
    return removed


def find_stale(folder: Path = _FOLDER, young: float = _YOUNG_S) -> list[str]:
    """Names of this user's lock files of Fast DDS that no living process holds; nothing is removed.

    Args:
        folder: where the files are.
        young: files made less than so many seconds ago are left out.
    """
    return [
        name
        for name in sorted(os.listdir(folder))
        if _LOCK.fullmatch(name) and _is_old_and_ours(folder / name, young) and _is_free(folder / name)
    ]


def held_by(process_id: int) -> set[str]:
    """Names of the lock files of Fast DDS that a process has open.

    Raises:
        OSError: the process has ended.
    """
    names = set()
    for entry in os.listdir(f"/proc/{process_id}/fd"):
        # A descriptor may be closed in between.
        with suppress(FileNotFoundError):
            names.add(Path(os.readlink(f"/proc/{process_id}/fd/{entry}")).name)
    return {name for name in names if _LOCK.fullmatch(name)}


def mapped(folder: Path = _FOLDER) -> set[str]:
    """Names of the files in ``folder`` that processes have mapped, as far as this user may look at them."""
    names = set()
    for process in Path("/proc").glob("[0-9]*"):
        # Processes end meanwhile, and those of others do not show theirs.
        with suppress(OSError):
            names |= {path.name for _, path in mappings(process) if path.parent == folder}
    return names


def mappings(process: Path) -> Iterator[tuple[int, Path]]:
    """Inode and path of each file that a process has mapped; the path of a removed one ends in `` (deleted)``.

    Args:
        process: its folder in /proc.

    Raises:
        OSError: it has ended, or does not show them.
    """
    for line in (process / "maps").read_text().splitlines():
        words = line.split(maxsplit=5)
        if len(words) == 6:
            yield int(words[4]), Path(words[5])


def _is_free(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        return _locked(descriptor)
    finally:
        os.close(descriptor)


def _is_held(path: Path) -> bool:
    return path.exists() and not _is_free(path)


@contextmanager
def _alone(folder: Path) -> Iterator[bool]:
    """Whether no other process cleans meanwhile.

    Without it the second cleaner could take the lock on a file that the first has just removed, and then remove the
    new one of that name, which the first's node has made since.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        yield False
        return
    try:
        deadline = time.monotonic() + _PATIENCE_S
        while True:
            if _locked(descriptor):
                yield True
                return
            if time.monotonic() > deadline:
                yield False
                return
            time.sleep(0.01)
    finally:
        os.close(descriptor)


def _locked(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _is_old_and_ours(path: Path, young: float) -> bool:
    try:
        status = path.lstat()
    except OSError:
        return False
    return status.st_uid == os.geteuid() and time.time() - max(status.st_mtime, status.st_ctime) > young


def _removed_if_free(folder: Path, lock: str, name: str) -> list[str]:
    try:
        descriptor = os.open(folder / lock, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return []
    try:
        if not _locked(descriptor) or _is_held(folder / f"{name}{_OTHER[lock[-3:]]}"):
            return []
        # The lock file last, and while it is held: until then everybody takes the port for one in use.
        return _removed(folder, name, f"sem.{name}_mutex", lock)
    finally:
        os.close(descriptor)


def _removed(folder: Path, *names: str) -> list[str]:
    gone = []
    for name in names:
        if _is_old_and_ours(folder / name, 0.0):
            try:
                os.unlink(folder / name)
            except OSError:
                continue
            gone.append(name)
    return gone
