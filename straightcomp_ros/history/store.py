"""A store: folders of Parquet files that any number of processes may add to at once.

    strokes/stage=NAME/month=YYYY-MM/CHECKSUM.parquet    the strokes of the bag with this checksum
    bags/HASH.parquet                                    one row: the bag at the place whose hash this is

A file is a function of its bag alone, and appears whole under its name. Processes that add the same bag write the same
bytes, so no lock is needed, and a process that is killed leaves nothing that the next one does not write again. The
strokes are written before the row that says so.
"""

from __future__ import annotations

import os
import secrets
import time
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote, unquote

from straightcomp_ros.history import HistoryError, StorageError
from straightcomp_ros.history.bag_places import BagPlace, file_system, reaching
from straightcomp_ros.history.bag_row import BagRow
from straightcomp_ros.history.evaluated_bag import EvaluatedBag, parquet
from straightcomp_ros.history.recorded_facts import checksum_of
from straightcomp_ros.history.row_columns import arrow, schema_of
from straightcomp_ros.history.stroke_row import PARTITIONS, StrokeRow
from straightcomp_ros.settings.whole_file import write_whole

if TYPE_CHECKING:
    import pyarrow

STROKES, BAGS = "strokes", "bags"
_PARTS = ".parts"
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
        found = pyarrow.parquet.read_table(pyarrow.BufferReader(data)).to_pylist()[0]
        same = (found["size"], found["modified"]) == (place.size, place.modified)
        return same and place.modified is not None and found["checksum"] is not None

    def put(self, bag: EvaluatedBag) -> None:
        """Write what a bag gives. Raises OSError when the store cannot be written."""
        row = bag.row
        if bag.strokes is not None:
            folders = (f"{name}={quote(str(getattr(row, name)), safe='')}" for name in PARTITIONS)
            self._write("/".join((self.root, STROKES, *folders, f"{row.checksum}.parquet")), bag.strokes)
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
        :class:`straightcomp_ros.history.stroke_row.StrokeRow`, or those named. Raises HistoryError for a stage that the
        store does not have."""
        import pyarrow.dataset

        folder = f"{self.root}/{STROKES}/stage={quote(stage, safe='')}"
        if not self.files.isdir(folder):
            known = ", ".join(self.stages()) or "none"
            raise HistoryError(f"store {self.url}: has no stage '{stage}'; its stages are: {known}")
        data = pyarrow.dataset.dataset(folder, schema_of(StrokeRow), format="parquet", filesystem=self.files)
        keys = ["start", "checksum", "stroke"]
        wanted = data.schema.names if columns is None else columns
        table = data.to_table(columns=[*wanted, *(key for key in keys if key not in wanted)])
        return table.sort_by([(key, "ascending") for key in keys]).select(wanted)

    def clear_abandoned(self) -> None:
        """Remove what killed processes have left half-written."""
        if not self.local:
            return
        for part in Path(self.root, _PARTS).glob("*"):
            try:
                if time.time() - part.stat().st_mtime > _ABANDONED_S:
                    part.unlink()
            except FileNotFoundError:
                continue  # another process was faster

    def _bag_file(self, location: str) -> str:
        return f"{self.root}/{BAGS}/{checksum_of([location.encode()])}.parquet"

    def _write(self, path: str, data: bytes) -> None:
        if not self.local:
            try:
                with reaching(self.url):
                    # An object appears whole.
                    self.files.pipe_file(path, data)
            except FileNotFoundError as error:
                raise StorageError(f"store {self.url} cannot be written: {error}") from error
            return
        parts = Path(self.root, _PARTS)
        for folder in (parts, Path(path).parent):
            folder.mkdir(parents=True, exist_ok=True)
        write_whole(Path(path), data, parts / f"{os.getpid()}-{secrets.token_hex(8)}")
