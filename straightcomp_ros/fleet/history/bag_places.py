"""Finds bags below a folder, on this machine or at any URL that fsspec knows; in folders that grow, each bag once.

Folders that grow are listed again and again, since network file systems and S3 report no changes.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from straightcomp_ros.bags.folder import STORED, split_number
from straightcomp_ros.fleet.history import HistoryError, StorageError
from straightcomp_ros.fleet.history.rows import BagRow

_METADATA = "metadata.yaml"


class BagPlace(NamedTuple):
    """A bag that was found, and how its files were at that time."""

    location: str  # full path or URL of the folder or file
    names: tuple[str, ...]  # of its files, within the folder; a bag that is one file has none
    size: int  # of its files, bytes
    modified: datetime | None  # when the newest of them was changed, UTC; None where the storage does not say


def file_system(url: str) -> tuple[Any, str, bool]:
    """The fsspec file system of a path or URL, the path on it, and whether it is this machine's own. Raises
    HistoryError when there is none for such URLs."""
    import fsspec
    from fsspec.implementations.local import LocalFileSystem

    try:
        # A list that is kept would hide changes, and fill the memory.
        files, path = fsspec.core.url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        raise HistoryError(f"{url}: {error}; e.g. pip install s3fs") from error
    except ValueError as error:
        raise HistoryError(f"{url}: {error}; allowed: a path, or a URL such as s3://BUCKET/FOLDER") from error
    return files, path, isinstance(files, LocalFileSystem)


@contextmanager
def reaching(url: str) -> Iterator[None]:
    """Raise StorageError for whatever the client of a storage raises but FileNotFoundError: each has its own errors."""
    try:
        yield
    except (FileNotFoundError, HistoryError, StorageError):
        raise
    except Exception as error:
        raise StorageError(f"{url}: {error}") from error


def bags_in(url: str) -> Iterator[BagPlace]:
    """The bag at ``url``, or all bags below that folder, in the order of their names.

    A folder with metadata.yaml is a bag, as is one whose files are splits of recordings by their numbers (of several
    recordings: a bag that cannot be evaluated). Other MCAP and SQLite files, compressed as a whole or not, are bags of
    their own. What lies below a bag is looked at too. Links to folders are not followed. A folder below that this user
    may not list is left out, with a warning (UserWarning).

    Raises:
        HistoryError: nothing is there.
        StorageError: it cannot be listed.
    """
    with reaching(url):
        files, path, local = file_system(url)
        if not files.exists(path):
            raise HistoryError(
                f"{url} does not exist; give a bag, a folder of bags, or a URL such as s3://BUCKET/FOLDER"
            )
        if files.isdir(path):
            yield from _below(files, path.rstrip("/") or path, local)
        else:
            yield BagPlace(_location(files, path, local), (), *_state_of(files.info(path)))


def _below(files: Any, path: str, local: bool) -> Iterator[BagPlace]:
    try:
        entries = sorted(_listed(files, path))
    except FileNotFoundError:
        return  # removed meanwhile
    messages = [name for name, folder, *_ in entries if not folder and STORED.fullmatch(name)]
    numbered = [name for name, number, _ in (split_number(Path(name)) for name in messages) if number >= 0]
    splits = len(set(numbered)) < len(numbered) or len(numbered) == len(messages) == 1
    known = {name: (size, modified) for name, folder, size, modified in entries if not folder}
    if messages and (splits or _METADATA in known):
        names = tuple(name for name in known if name == _METADATA or name in messages)
        sizes, times = zip(*(known[name] for name in names), strict=True)
        newest = max((time for time in times if time is not None), default=None)
        yield BagPlace(_location(files, path, local), names, sum(sizes), newest)
        messages = []
    for name in messages:
        yield BagPlace(_location(files, f"{path}/{name}", local), (), *known[name])
    for name, folder, *_ in entries:
        if folder:
            try:
                yield from _below(files, f"{path}/{name}", local)
            except PermissionError as error:
                why = error.strerror or error
                warnings.warn(f"folder {path}/{name}: left out, since it cannot be listed: {why}", stacklevel=2)


def _listed(files: Any, path: str) -> Iterator[tuple[str, bool, int, datetime | None]]:
    """Of what is in a folder the name, whether it is a folder, and the state."""
    for info in files.ls(path, detail=True):
        name = info["name"]
        if info["type"] == "other" and files.isfile(name):
            info = files.info(name)  # what a link leads to
        # S3 lists a folder as a file of its own.
        if info["type"] == "directory" or (info["type"] == "file" and name.rstrip("/") != path):
            yield PurePosixPath(name).name, info["type"] == "directory", *_state_of(info)


def _location(files: Any, path: str, local: bool) -> str:
    return path if local else str(files.unstrip_protocol(path))


def _state_of(info: Mapping[str, Any]) -> tuple[int, datetime | None]:
    """Size in bytes and time of change. Storages name the time differently: this machine as the first, S3 as the
    second, Azure and Google as the others."""
    known = (info.get(name) for name in ("mtime", "LastModified", "last_modified", "updated"))
    times = (datetime.fromtimestamp(one, timezone.utc) if isinstance(one, float) else one for one in known)
    return info["size"], next((one.astimezone(timezone.utc) for one in times if isinstance(one, datetime)), None)


class GrowingFolders:
    """Remembers how often in a row it has seen each bag as it is: 0.1 kB for each."""

    def __init__(self) -> None:
        self._looks: dict[int, int] = {}

    def resting(self, places: Iterable[BagPlace]) -> Iterator[BagPlace]:
        """Of the bags that are there now those that are as at the call before, each once."""
        before, self._looks = self._looks, {}
        for place in places:
            state = _state(place)
            self._looks[state] = before.get(state, 0) + 1
            if self._looks[state] == 2:
                yield place

    def retry(self, row: BagRow) -> None:
        """Give the bag of a row out again, if it is there."""
        self._looks[_state(row)] = 1


def _state(place: BagPlace | BagRow) -> int:
    return hash((place.location, place.size, place.modified))
