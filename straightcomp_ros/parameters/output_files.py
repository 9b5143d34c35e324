"""Files that are written whole or not at all, and folders of them: what this package has made there may be replaced,
everything else is kept.

A file in an output folder, the mark, says what was made there: names, sizes and times of the last change. A name that
the mark does not have, or whose files were changed since, is not replaced without being asked.
"""

import ctypes
import errno
import fcntl
import json
import math
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

_NEW, _PRIVATE = 0o666, 0o600
_THIS_FOLDER, _EXCHANGE = -100, 2
"""AT_FDCWD and RENAME_EXCHANGE of Linux."""


def write_whole(path: str | Path, content: str | bytes, folder: Path | None = None, *, private: bool = False) -> None:
    """Write ``content`` to ``path``: whoever reads it, or whatever interrupts, finds the old file or the new one.

    It is written to a new file, brought to the disk, and renamed. A file that was there keeps its mode and owner, and
    the link that leads to it; write only where no other user can make one. A pipe or a device gets the content itself.

    Args:
        content: a text is written as of :func:`utf8`.
        folder: of the new file until it is whole, on the same file system; that of ``path`` by default.
        private: readable for its owner only, whatever its mode was before.

    Raises:
        OSError: it cannot be written; ``filename`` is ``path``, and what was there is untouched.
    """
    path = Path(path)
    data = utf8(content) if isinstance(content, str) else content
    target = Path(os.path.realpath(path))
    # Short enough for every file system. Readers of a folder leave out names with a dot.
    part = (folder or target.parent) / f".{target.name[:40]}.{secrets.token_hex(8)}.part"
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(data)
            return
        before = target.stat() if os.path.lexists(target) else None
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        with open(os.open(part, flags, _PRIVATE if private or before else _NEW), "wb") as file:
            if before is not None:
                with suppress(OSError):  # only root may give a file away
                    os.fchown(file.fileno(), before.st_uid, before.st_gid)
                os.fchmod(file.fileno(), _PRIVATE if private else before.st_mode & 0o7777)
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
    sync_names(target.parent)


def utf8(text: str) -> bytes:
    """The text as UTF-8; bytes of a file's name that are none, as ``\\udcfc``, which JSON reads as the name again."""
    return text.encode(errors="backslashreplace")


def check_writable(path: str | Path) -> None:
    """Raise the OSError with which :func:`write_whole` would fail now, as far as that shows before something is
    written: ``path`` is a folder, or its own folder takes no new file."""
    path = Path(path)
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if path.is_file() or not path.exists():
            with suppress(FileNotFoundError):
                path.stat()  # raises where links lead to each other
            with tempfile.TemporaryFile(dir=os.path.dirname(os.path.realpath(path))):
                pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def sync_names(folder: Path) -> None:
    """Bring the names in a folder to the disk, where its file system can do that."""
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
    try:
        lock = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, _NEW)
    except PermissionError:
        # One that root has made is locked without writing; only NFS locks no such file.
        lock = os.open(file, os.O_RDONLY | os.O_CREAT | os.O_CLOEXEC, _NEW)
    try:
        with suppress(OSError):
            # Others than its owner lock it too, whatever the umask was: it has no content.
            os.fchmod(lock, os.fstat(lock).st_mode & 0o777 | 0o444)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError as error:  # of a network's file system without locks
            raise OSError(error.errno, error.strerror, str(file)) from error
        yield
    finally:
        os.close(lock)


def plain(value: Any) -> Any:
    """Copy with lists instead of tuples, and None instead of numbers that are not finite, which JSON lacks."""
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_text(value: Any) -> str:
    """The content of a JSON file, of :func:`plain` values."""
    return json.dumps(plain(value), indent=1, ensure_ascii=False) + "\n"


MARK, UNFINISHED = ".straightcomp_made.json", "unfinished"
"""Names in an output folder: of the mark, and of the folder of what is not finished yet, or has failed."""


class OutputRefused(ValueError):
    """Something in an output folder would be lost; the message names it, and what helps."""


@contextmanager
def making(
    folder: Path,
    names: Iterable[str],
    *,
    reads: Iterable[Path] = (),
    force: bool = False,
    anew: bool = True,
    changing: Sequence[str] = (),
) -> Iterator[Path]:
    """Make files or folders called ``names`` in ``folder`` during the block, and mark them as made here.

    Args:
        folder: made if it is not there.
        names: of all that the block may write in the folder.
        reads: what the block reads: never replaced, not even with ``force``.
        force: replace what was not made here, too.
        anew: the block writes into a new folder, whose content takes the place of what was there when all has gone
            well; otherwise it changes what is there.
        changing: those of the names that others go on writing: made here, whatever they hold by now.

    Returns:
        Where the block is to write: ``folder`` itself unless ``anew``.

    Raises:
        OutputRefused: a name is there that was not made here, or is read, or another process writes there.
        OSError: the folder cannot be written.
        BaseException: what the block raises; its attribute ``kept`` is the folder of unfinished files, if any.
    """
    folder, names = Path(folder), list(dict.fromkeys(names))
    place = folder / UNFINISHED if anew else folder
    folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder):
        made = _marked(folder)
        for path in [folder / name for name in names] + [place] * anew:
            for read in reads:
                if same_or_within(read, path):
                    raise OutputRefused(f"{path}: would be replaced, but is read: {read}; name another output folder")
            # Only what the mark has is looked through: another folder may be large, or closed.
            if force or not os.path.lexists(path):
                continue
            if path.name not in made or not (path.name in changing or made[path.name] in (None, _files(path))):
                raise OutputRefused(
                    f"{path}: was not made by straightcomp, or was changed since; name another output folder, or give "
                    "--force to replace it"
                )
        # Before a change: a kill leaves what is marked. Under a name that the mark has without files may be anything.
        made |= dict.fromkeys([UNFINISHED] if anew else names)
        _mark(folder, made)
        if anew:
            remove(place)
            place.mkdir()
        try:
            yield place
        except BaseException as error:
            with suppress(OSError):
                _mark(folder, made | _found(folder, made))
                if anew and any(place.iterdir()):
                    error.kept = place  # type: ignore[attr-defined]
            raise
        if anew:
            made |= dict.fromkeys(names)
            _mark(folder, made)
            for name in names:
                _put(place / name, folder / name)
            remove(place)
        _mark(folder, made | _found(folder, names))


def _put(new: Path, path: Path) -> None:
    """Move ``new`` to ``path``, or remove what is there if there is no new one."""
    if os.path.lexists(new) and os.path.lexists(path):
        try:
            exchange(new, path)
        except OSError:  # not every file system can
            os.rename(path, new.with_name(f"former_{new.name}"))
            os.rename(new, path)
    elif os.path.lexists(new):
        os.rename(new, path)
    else:
        remove(path)


def same_or_within(read: Path, path: Path) -> bool:
    """Whether ``read`` is ``path`` or lies in it, whatever links lead there."""
    found, place = Path(os.path.realpath(read)), Path(os.path.realpath(path))
    return place == found or place in found.parents or (found.exists() and place.exists() and found.samefile(place))


def remove(path: Path) -> None:
    """Remove a file, a link or a folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def clear(folder: Path, *, made: bool) -> None:
    """Remove what is in a folder that was empty or absent before, and the folder if it was ``made`` since, as far as
    that goes: there is an error already."""
    with suppress(OSError):
        for path in folder.iterdir():
            remove(path)
        if made:
            folder.rmdir()


def _files(path: Path) -> dict[str, list[int]]:
    """Size and time of the last change of each file under ``path``, by its name there; links are not followed. Without
    the incidents of the logger, which may be packed after the end of the run that is marked."""
    inside = path.is_dir() and not path.is_symlink()
    paths = sorted(one for one in path.rglob("*") if one.is_symlink() or not one.is_dir()) if inside else [path]
    stats = ((one, one.lstat()) for one in paths)
    return {
        str(one.relative_to(path)): [stat.st_size, stat.st_mtime_ns]
        for one, stat in stats
        if not one.match("*_incidents/????_??_??-??_??_??_*.zip")
    }


def _marked(folder: Path) -> dict[str, Any]:
    try:
        made = json.loads((folder / MARK).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return made if isinstance(made, dict) else {}


def _found(folder: Path, names: Iterable[str]) -> dict[str, Any]:
    return {name: _files(folder / name) for name in names if os.path.lexists(folder / name)}


def _mark(folder: Path, made: Mapping[str, Any]) -> None:
    write_whole(folder / MARK, json.dumps(made, indent=1, sort_keys=True) + "\n")


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        with suppress(OSError):  # not every network's file system locks a folder
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise OutputRefused(f"{folder}: another straightcomp writes there; wait, or name another") from None
        yield
    finally:
        os.close(descriptor)
