"""Finds the files that the package installs (config/, launch/), and a folder for those of the user that it keeps."""

import errno
import os
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

PACKAGE = "straightcomp_ros"


def _candidates() -> Iterator[Path]:
    yield Path(__file__).resolve().parents[2]  # source checkout, editable install
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix:
            yield Path(prefix) / "share" / PACKAGE
    yield Path(sys.prefix) / "share" / PACKAGE
    for parent in Path(__file__).resolve().parents:  # pip install --prefix, colcon's install space
        yield parent / "share" / PACKAGE


def share_path(name: str) -> Path:
    """Full path of an installed file, e.g. ``config/survey_synthetic.csv``.

    Raises:
        FileNotFoundError: no installation path has the file.
    """
    tried = []
    for base in _candidates():
        if os.path.exists(base / name):  # False for a name that is too long, too
            return base / name
        tried.append(str(base))
    raise FileNotFoundError(f"'{name}' of {PACKAGE} is in none of: {', '.join(tried)}; is the package installed?")


def named_file(name: str) -> Path:
    """Path of a file that a parameter names, from the working directory or the home folder (``~``), else an installed
    one; of what is nowhere too, so that its reader refuses it by its name."""
    path = os.path.expanduser(name)
    if not os.path.exists(path):
        with suppress(FileNotFoundError):
            return share_path(name)
    return Path(path)


@cache
def private_folder() -> Path:
    """A folder that only this user can write to, the same for all processes: in the user's cache, else in the temporary
    folder, else a new one for this process.

    What another user may have put there is never taken: machine code in it would run, a link would lead elsewhere.
    """
    # Without HOME and an entry of this user in the system's list, ~ stays as it is.
    home = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    for place in (home / PACKAGE, Path(tempfile.gettempdir()) / f"{PACKAGE}-{os.getuid()}"):
        if not place.is_absolute():
            continue
        try:
            make_private(place)
        except OSError:
            continue
        return place
    return Path(tempfile.mkdtemp(prefix=f"{PACKAGE}-"))


def make_private(folder: Path) -> None:
    """Make a folder for this user alone, unless it is there; OSError if others made it or may write to it."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise PermissionError(errno.EPERM, "is not this user's alone", str(folder))
    if not os.access(folder, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))
