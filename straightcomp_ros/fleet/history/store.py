"""A store: folders of Parquet files that any number of processes may add to at once.

    strokes/stage=NAME/month=YYYY-MM/CHECKSUM.parquet    the strokes of the bag with this checksum
    strokes/stage=NAME/month=YYYY-MM/compacted-HASH.parquet    those of all bags that were compacted
    bags/HASH.parquet                                    one row: the bag at the place whose hash this is

A file of a bag is a function of the bag alone, and appears whole under its name. Processes that add the same bag write
the same bytes, and a process that is killed leaves nothing that the next one does not write again. The strokes are
written before the row that says so. A lock keeps compacting and writing apart on a local disk.
"""

from __future__ import annotations

import os
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, unquote

from straightcomp_ros.fleet.history import HistoryError, StorageError, month_folder
from straightcomp_ros.fleet.history.bag_places import BagPlace, file_system, reaching
from straightcomp_ros.fleet.history.bag_row import BagRow
from straightcomp_ros.fleet.history.evaluated_bag import EvaluatedBag, parquet
from straightcomp_ros.fleet.history.month_folder import KEYS
from straightcomp_ros.fleet.history.recorded_facts import checksum_of, stored_name
from straightcomp_ros.fleet.history.row_columns import arrow, schema_of
from straightcomp_ros.fleet.history.stroke_row import PARTITIONS, StrokeRow
from straightcomp_ros.parameters.output_files import write_whole

if TYPE_CHECKING:
    import pyarrow

STROKES, BAGS = "strokes", "bags"
_PARTS = ".parts"
_TRIES = 3
"""Compacting exchanges a month once: two in the same read are rare."""
_ABANDONED_S = 60.0
"""Age of a file in ``.parts`` from which whoever wrote it has been killed: writing takes milliseconds."""


class Store:
    """A store at a path or URL. Raises HistoryError for a URL of an unknown kind, a path that is a file, or where the
    packages for stores are not installed.

    Attributes:
        url: as it was given.
        files, root: its fsspec file system, and its path there.
        local: whether that is this machine's own.
    """

    def __init__(self, url: str) -> None:
        arrow()  # tells that it is missing before anything is evaluated
        self.url = url
        self.files, root, self.local = file_system(url)
        self.root = root.rstrip("/")
        with reaching(url):
            is_file = self.files.isfile(self.root)
        if is_file:
            raise HistoryError(f"store {url}: is a file; name a folder")

    def has(self, place: BagPlace) -> bool:
        """Whether a bag was added, or refused, as it is now. One that could not be read is to be tried again."""
        import pyarrow.parquet

        try:
            with reaching(self.url):
                data = self.files.cat_file(self._bag_file(place.location))
        except FileNotFoundError:
            return False
        try:
            found = pyarrow.parquet.read_table(pyarrow.BufferReader(data)).to_pylist()[0]
        except (pyarrow.ArrowException, LookupError):
            return False  # a damaged row is written anew
        same = (found["size"], found["modified"]) == (place.size, place.modified)
        return same and place.modified is not None and found["checksum"] is not None

    def put(self, bag: EvaluatedBag) -> None:
        """Write what a bag gives. Raises OSError when the store cannot be written."""
        row = bag.row
        if bag.strokes is not None:
            folders = (f"{name}={quote(str(getattr(row, name)), safe='')}" for name in PARTITIONS)
            self._write_strokes("/".join((self.root, STROKES, *folders)), str(row.checksum), bag.strokes)
        self._write(self._bag_file(row.location), parquet(BagRow, [row]))

    def stages(self) -> list[str]:
        """Names of the stages, sorted."""
        folder = f"{self.root}/{STROKES}"
        if not self.files.isdir(folder):
            return []
        names = (str(path).rstrip("/").rpartition("/")[2] for path in self.files.ls(folder, detail=False))
        return sorted(unquote(name.removeprefix("stage=")) for name in names if name.startswith("stage="))

    def strokes(self, stage: str, columns: list[str] | None = None) -> pyarrow.Table:
        """The strokes of a stage, sorted by ``start``, ``checksum`` and ``stroke``: all columns of
        :class:`straightcomp_ros.fleet.history.stroke_row.StrokeRow`, or those named. Raises HistoryError for a stage
        that the store does not have."""
        folder = f"{self.root}/{STROKES}/stage={quote(stored_name(stage), safe='')}"
        if not self.files.isdir(folder):
            known = ", ".join(self.stages()) or "none"
            raise HistoryError(f"store {self.url}: has no stage '{stage}'; its stages are: {known}")
        # A month that is compacted after it was listed is to be listed again.
        for _ in range(_TRIES):
            with suppress(FileNotFoundError):
                return _sorted_strokes(self.files, folder, columns)
        return _sorted_strokes(self.files, folder, columns)

    def clear_abandoned(self) -> None:
        """Remove what killed processes have left half-written."""
        if not self.local:
            return
        for part in Path(self.root, _PARTS).glob("*"):
            try:
                if time.time() - part.stat().st_mtime > _ABANDONED_S:
                    shutil.rmtree(part) if part.is_dir() else part.unlink()
            except FileNotFoundError:
                continue  # another process was faster

    def compact(self) -> Iterator[tuple[str, int]]:
        """Make one file of the strokes of each stage and month; gives each month's folder, and how many files became
        one, 0 where one was all. Nothing is lost or doubled at any moment, whatever is killed.

        Raises:
            HistoryError: the store is not on a disk of this machine, or a file is damaged.
            OSError: it cannot be written.
        """
        from pyarrow import ArrowException

        if not self.local:
            raise HistoryError(f"store {self.url}: cannot be compacted; allowed: a folder of this machine")
        self.clear_abandoned()
        root = Path(self.root)
        for month in sorted(root.glob(f"{STROKES}/stage=*/month=*")):
            part = self._parts() / f"{os.getpid()}-{secrets.token_hex(8)}"
            try:
                with month_folder.alone(root):
                    merged = month_folder.compact(month, part)
            except ArrowException as error:
                raise HistoryError(f"store {self.url}: {month}: {error}") from error
            yield str(month.relative_to(root / STROKES)), merged

    def _bag_file(self, location: str) -> str:
        return f"{self.root}/{BAGS}/{checksum_of([location.encode('utf-8', 'surrogateescape')])}.parquet"

    def _write(self, path: str, data: bytes) -> None:
        if not self.local:
            try:
                with reaching(self.url):
                    # An object appears whole.
                    self.files.pipe_file(path, data)
            except FileNotFoundError as error:
                raise StorageError(f"store {self.url} cannot be written: {error}") from error
            return
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_whole(Path(path), data, self._parts())

    def _write_strokes(self, month: str, checksum: str, data: bytes) -> None:
        if not self.local:
            self._write(f"{month}/{checksum}.parquet", data)
            return
        Path(month).mkdir(parents=True, exist_ok=True)
        with month_folder.alone(Path(self.root)):
            month_folder.write_bag(Path(month), checksum, data, self._parts())

    def _parts(self) -> Path:
        """Folder of what is to appear whole."""
        parts = Path(self.root, _PARTS)
        parts.mkdir(parents=True, exist_ok=True)
        return parts


def _sorted_strokes(files: Any, folder: str, columns: list[str] | None) -> pyarrow.Table:
    import pyarrow.dataset

    data = pyarrow.dataset.dataset(folder, schema_of(StrokeRow), format="parquet", filesystem=files)
    keys = [key for key, _ in KEYS]
    wanted = data.schema.names if columns is None else columns
    table = data.to_table(columns=[*wanted, *(key for key in keys if key not in wanted)])
    return table.sort_by(KEYS).select(wanted)
