"""Output folders: what this package has made there may be replaced, everything else is kept.

A file in the folder, the mark, says what was made there: names, sizes and times of the last change. A name that the
mark does not have, or whose files were changed since, is not replaced without being asked.
"""

import fcntl
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from straightcomp_ros.parameters.whole_file import exchange, write_whole

MARK, UNFINISHED = ".straightcomp_made.json", "unfinished"
"""Names in an output folder: of the mark, and of the folder of what is not finished yet, or has failed."""


class OutputRefused(ValueError):
    """Something in an output folder would be lost; the message names it, and what helps."""


@contextmanager
def making(
    folder: Path, names: Iterable[str], *, reads: Iterable[Path] = (), force: bool = False, anew: bool = True
) -> Iterator[Path]:
    """Make files or folders called ``names`` in ``folder`` during the block, and mark them as made here.

    Args:
        folder: made if it is not there.
        names: of all that the block may write in the folder.
        reads: what the block reads: never replaced, not even with ``force``.
        force: replace what was not made here, too.
        anew: the block writes into a new folder, whose content takes the place of what was there when all has gone
            well; otherwise it changes what is there.

    Returns:
        Where the block is to write: ``folder`` itself unless ``anew``.

    Raises:
        OutputRefused: a name is there that was not made here, or is read, or another process writes there.
        OSError: the folder cannot be written.
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
            if os.path.lexists(path) and not force and not _made_here(path, made):
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
        except BaseException:
            with suppress(OSError):
                _mark(folder, made | _found(folder, made))
            raise
        if anew:
            made |= dict.fromkeys(names)
            _mark(folder, made)
            for name in names:
                _put(place / name, folder / name)
            remove(place)
        _mark(folder, made | _found(folder, names))


def _made_here(path: Path, made: Mapping[str, Any]) -> bool:
    return path.name in made and made[path.name] in (None, _files(path))


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
