"""Output folders: what this package has made there may be replaced, everything else is kept.

A file in the folder, the mark, says what was made there: names, sizes and times of the last change. A name that the
mark does not have, or whose files were changed since, is not replaced without being asked.
"""

import fcntl
import json
import os
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from straightcomp_ros.settings.whole_file import write_whole

MARK = ".straightcomp_made.json"
_UNFINISHED = None
"""In place of the files under a name that is being written: after a kill they are anything."""


class OutputRefused(ValueError):
    """Something in an output folder would be lost; the message names it, and what helps."""


@contextmanager
def making(
    folder: Path, names: Iterable[str], *, reads: Iterable[Path] = (), force: bool = False, anew: bool = True
) -> Iterator[None]:
    """Make files or folders called ``names`` in ``folder`` during the block, and mark them as made here.

    Args:
        folder: made if it is not there.
        names: of all that the block may write in the folder.
        reads: what the block reads: never replaced, not even with ``force``.
        force: replace what was not made here, too.
        anew: what was there is removed first; otherwise the block changes it.

    Raises:
        OutputRefused: a name is there that was not made here, or is read, or another process writes there.
        OSError: the folder cannot be written.
    """
    folder, names = Path(folder), list(dict.fromkeys(names))
    folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder):
        made = _marked(folder)
        for name in names:
            path = folder / name
            for read in reads:
                if same_or_within(read, path):
                    raise OutputRefused(f"{path}: would be replaced, but is read: {read}; name another output folder")
            if force or not os.path.lexists(path):
                continue
            if name not in made or made[name] not in (_UNFINISHED, _files(path)):
                raise OutputRefused(
                    f"{path}: was not made by straightcomp, or was changed since; name another output folder, or give "
                    "--force to replace it"
                )
        # First: a kill between the two leaves what is marked, not what is not.
        _mark(folder, made | dict.fromkeys(names, _UNFINISHED))
        if anew:
            for name in names:
                remove(folder / name)
        try:
            yield
        except BaseException:
            with suppress(OSError):
                _mark(folder, made, names)
            raise
        _mark(folder, made, names)


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


def _files(path: Path) -> dict[str, list[int]]:
    """Size and time of the last change of each file under ``path``, by its name there; links are not followed."""
    inside = path.is_dir() and not path.is_symlink()
    paths = sorted(one for one in path.rglob("*") if one.is_symlink() or not one.is_dir()) if inside else [path]
    stats = ((one, one.lstat()) for one in paths)
    return {str(one.relative_to(path)): [stat.st_size, stat.st_mtime_ns] for one, stat in stats}


def _marked(folder: Path) -> dict[str, Any]:
    try:
        made = json.loads((folder / MARK).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return made if isinstance(made, dict) else {}


def _mark(folder: Path, made: dict[str, Any], finished: Collection[str] = ()) -> None:
    found = {name: _files(folder / name) for name in finished if os.path.lexists(folder / name)}
    others = {name: files for name, files in made.items() if name not in finished}
    write_whole(folder / MARK, json.dumps({**others, **found}, indent=1, sort_keys=True) + "\n")


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
