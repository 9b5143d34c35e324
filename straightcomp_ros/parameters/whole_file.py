"""Files that are written whole or not at all."""

import ctypes
import errno
import fcntl
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_NEW, _PRIVATE = 0o666, 0o600
_THIS_FOLDER, _EXCHANGE = -100, 2
"""AT_FDCWD and RENAME_EXCHANGE of Linux."""


def write_whole(path: str | Path, content: str | bytes, folder: Path | None = None, *, private: bool = False) -> None:
    """Write ``content`` to ``path``: whoever reads it, or whatever interrupts, finds the old file or the new one.

    It is written to a new file, brought to the disk, and renamed. A file that was there keeps its mode and owner, and
    the link that leads to it; write only where no other user can make one. A pipe or a device gets the content itself.

    Args:
        path: the file.
        content: text as UTF-8, or bytes.
        folder: of the new file until it is whole, on the same file system; that of ``path`` by default.
        private: readable for its owner only, whatever it was before.

    Raises:
        OSError: it cannot be written; ``filename`` is ``path``, and what was there is untouched.
    """
    path = Path(path)
    data = content.encode() if isinstance(content, str) else content
    target = Path(os.path.realpath(path))
    # Short enough for every file system. Readers of a folder leave out names with a dot.
    part = (folder or target.parent) / f".{target.name[:40]}.{secrets.token_hex(8)}.part"
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(data)
            return
        before = target.stat() if target.exists() else None
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        with open(os.open(part, flags, _PRIVATE if private or before else _NEW), "wb") as file:
            if before is not None and not private:
                with suppress(OSError):  # only root may give a file away
                    os.fchown(file.fileno(), before.st_uid, before.st_gid)
                os.fchmod(file.fileno(), before.st_mode & 0o7777)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, target)
    except BaseException as error:
        with suppress(OSError):
            part.unlink()
        if isinstance(error, OSError):
            # The user knows this name, not that of the part.
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    sync_folder(target.parent)


def sync_folder(folder: Path) -> None:
    """Bring a folder's names to the disk, where its file system can do that."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def exchange(one: Path, other: Path) -> None:
    """Let two files or folders of one file system change places in one step; OSError where it cannot do that."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.renameat2(_THIS_FOLDER, os.fsencode(one), _THIS_FOLDER, os.fsencode(other), _EXCHANGE):
        code = ctypes.get_errno()
        known = {errno.EINVAL: "its file system cannot exchange two folders"}
        raise OSError(code, known.get(code, os.strerror(code)), str(one))


@contextmanager
def locked(file: Path) -> Iterator[None]:
    """Wait until no other process has this lock, a file that is made if need be; the kernel frees it after a kill.

    Whoever reads a file, changes it and writes it again needs one, of another name: the file itself is replaced.
    """
    with file.open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
