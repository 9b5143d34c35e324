"""A store: folders of Parquet files that any number of processes may add to at once.

    strokes/stage=NAME/month=YYYY-MM/strokes.parquet     all strokes of a stage's month, on a local disk
    strokes/stage=NAME/month=YYYY-MM/CHECKSUM.parquet    the strokes of the bag with this checksum, on other storages
    bags/HASH.parquet                                    one row: the bag at the place whose hash this is

A month's file is a function of its bags alone, and is replaced as a whole under a lock, which the kernel takes from a
process that is killed. Other storages have no lock: there each bag has a file, which is a function of that bag. So
processes that add the same bags write the same bytes, and a process that is killed leaves nothing that the next one
does not write again. The strokes are written before the row that says so.

The strokes of a bag are in one file at any time: in a copy of another storage's store they stay in the bag's own.
"""

from __future__ import annotations

import glob
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import quote, unquote

from straightcomp_ros.fleet.history import HistoryError, StorageError
from straightcomp_ros.fleet.history.bag_places import BagPlace, file_system, reaching
from straightcomp_ros.fleet.history.rows import (
    BIN_MM,
    PARTITIONS,
    BagRow,
    StrokeRow,
    check_seal,
    checksum_of,
    parquet,
    rows_in,
    schema_of,
    sealed,
    stored_name,
)
from straightcomp_ros.parameters.output_files import locked, write_whole

if TYPE_CHECKING:
    import pyarrow

_Read = TypeVar("_Read")
STROKES, BAGS = "strokes", "bags"
_PARTS, _LOCK = ".parts", ".lock"
_MONTH = "strokes.parquet"
_VIEWS = f"""
CREATE VIEW refused AS SELECT location, size, modified, reason FROM bags WHERE reason IS NOT NULL;
CREATE VIEW bins AS
  SELECT stage, month, checksum, bag, stroke, start, direction, bins_from_mm + {BIN_MM} * (bin - 1) AS x_mm,
    error_bins_um[bin] AS error_um, residual_bins_um[bin] AS residual_um, current_bins_A[bin] AS current_A,
    guide_change_um[bin] AS guide_change_um
  FROM (SELECT *, unnest(range(1, len(error_bins_um) + 1)) AS bin FROM strokes);
"""
_ORDER = [(name, "ascending") for name in ("start", "checksum", "stroke")]
"""Order of the strokes of a stage."""


class Store:
    """A store at a path or URL. Raises HistoryError for a URL of an unknown kind or a path that is a file; every method
    raises StorageError where its storage does not answer.

    Attributes:
        url: as it was given.
        files, root: its fsspec file system, and its path there.
        local: whether that is this machine's own.
    """

    def __init__(self, url: str) -> None:
        import pyarrow  # noqa: F401 - if it is missing, that is reported before anything is evaluated

        self.url = url
        self.files, root, self.local = file_system(url)
        self.root = root.rstrip("/")
        with reaching(url):
            is_file = self.files.isfile(self.root)
        if is_file:
            raise HistoryError(f"store {url}: is a file; name a folder")

    def has(self, place: BagPlace, refused: bool = True) -> bool:
        """Whether a bag was added, or ``refused``, as it is now. One that could not be read is to be tried again."""
        found = self.row(place.location)
        same = (found.get("size"), found.get("modified")) == (place.size, place.modified)
        readable = place.modified is not None and found.get("checksum") is not None
        return same and readable and (refused or found["reason"] is None)

    def row(self, location: str) -> dict[str, Any]:
        """The row of the bag at this place by its columns, those of
        :class:`~straightcomp_ros.fleet.history.rows.BagRow`; empty where there is none, or it is damaged."""
        try:
            with reaching(self.url):
                data = self.files.cat_file(self._bag_file(location))
            return rows_in(BagRow, data).to_pylist()[0]  # type: ignore[no-any-return]
        except (FileNotFoundError, ValueError, LookupError):
            return {}

    def put(self, row: BagRow, strokes: bytes | None) -> None:
        """Write the row of a bag, and its strokes, a Parquet file, if it has not been refused.

        Raises:
            OSError: the store cannot be written.
            HistoryError: the file of the bag's month is damaged.
        """
        with self._alone():
            if strokes is not None:
                folders = (f"{name}={quote(str(getattr(row, name)), safe='')}" for name in PARTITIONS)
                month = "/".join((self.root, STROKES, *folders))
                if self.local:
                    self._add_to_month(Path(month), str(row.checksum), strokes)
                else:
                    self._write(f"{month}/{row.checksum}.parquet", strokes)
            self._write(self._bag_file(row.location), parquet(BagRow, [row]))

    def stages(self) -> list[str]:
        """Names of the stages, sorted."""
        folder = f"{self.root}/{STROKES}"
        with reaching(self.url):
            there = self.files.ls(folder, detail=False) if self.files.isdir(folder) else []
        names = (str(path).rstrip("/").rpartition("/")[2] for path in there)
        return sorted(unquote(name.removeprefix("stage=")) for name in names if name.startswith("stage="))

    def strokes(self, stage: str) -> pyarrow.Table:
        """The strokes of a stage, sorted by ``start``, ``checksum`` and ``stroke``. Raises HistoryError for a stage
        that the store does not have, or a damaged file."""
        import pyarrow

        folder = f"{self.root}/{STROKES}/stage={quote(stored_name(stage), safe='')}"
        with reaching(self.url):
            if not self.files.isdir(folder):
                known = ", ".join(self.stages()) or "none"
                raise HistoryError(f"store {self.url}: has no stage '{stage}'; its stages are: {known}")
        tables = self._each(folder, partial(rows_in, StrokeRow))
        return pyarrow.concat_tables([schema_of(StrokeRow).empty_table(), *tables]).sort_by(_ORDER)

    def query(self, sql: str) -> pyarrow.Table:
        """What a query in DuckDB's SQL gives. It only reads: a statement of another kind could replace a file.

        Its tables are ``strokes``, with the columns of :class:`~straightcomp_ros.fleet.history.rows.StrokeRow` and its
        partitions, ``bags``, of :class:`~straightcomp_ros.fleet.history.rows.BagRow`, ``refused``, the bags among them
        that have no strokes in the store, and ``bins``, one row for each bin of each stroke.

        Raises:
            HistoryError: there is no store, one of its files is damaged, or the query is refused.
        """
        import duckdb

        with duckdb.connect() as database:
            database.execute("SET TimeZone = 'UTC'")
            if not self.local:
                database.register_filesystem(self.files)
            try:
                if not self._add_table(database, BAGS, BagRow, ()):
                    make = f"straightcomp history add BAG -o {self.url}"
                    raise HistoryError(f"store {self.url}: no bag was added there; make it: {make}")
                self._add_table(database, STROKES, StrokeRow, PARTITIONS)
                database.execute(_VIEWS)
                for statement in database.extract_statements(sql):
                    if statement.type != duckdb.StatementType.SELECT:
                        raise HistoryError(f"query: {statement.type.name} is not allowed; allowed: SELECT")
                return database.sql(sql).to_arrow_table()
            except duckdb.Error as error:
                raise HistoryError(f"query: {' '.join(str(error).split())}") from error

    def _add_table(self, database: Any, name: str, row: type, partitions: tuple[str, ...]) -> bool:
        """Add a table of the store; returns whether it has files."""
        import pyarrow

        folder = f"{self.root}/{name}"
        # DuckDB takes damaged values for values.
        found = bool(self._each(folder, check_seal))
        if not self.local:
            folder = self.files.unstrip_protocol(folder)
        files = f"{glob.escape(folder)}/**/*.parquet".replace("'", "''")
        schema = pyarrow.schema([*schema_of(row), *((partition, pyarrow.string()) for partition in partitions)])
        database.register(declared := f"declared_{name}" if found else name, schema.empty_table())
        if not found:
            return False
        # A stage named 1 is no number.
        types = ", ".join(f"'{partition}': VARCHAR" for partition in partitions)
        hive = f", hive_partitioning = true, hive_types = {{{types}}}" if partitions else ""
        # A file of an earlier version lacks columns that were declared since.
        written = f"read_parquet('{files}', union_by_name = true{hive})"
        database.execute(f"CREATE VIEW {name} AS FROM {declared} UNION ALL BY NAME FROM {written}")
        return True

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """No other process writes to a local store meanwhile."""
        if not self.local:
            yield
            return
        Path(self.root).mkdir(parents=True, exist_ok=True)
        with locked(Path(self.root, _LOCK)):
            # Left by a process that was killed.
            for part in Path(self.root, _PARTS).glob("*"):
                part.unlink()
            yield

    def _each(self, folder: str, read: Callable[[bytes], _Read]) -> list[_Read]:
        """What ``read`` gives of each file below a folder, in threads: on another storage most of the time is the way
        there. Raises HistoryError for a damaged file."""

        def one(file: str) -> _Read:
            with reaching(self.url):
                data = self.files.cat_file(file)
            with self._whole(file):
                return read(data)

        with reaching(self.url):
            files = [file for file in self.files.find(folder) if file.endswith(".parquet")]
        with ThreadPoolExecutor() as threads:
            return list(threads.map(one, files))

    def _bag_file(self, location: str) -> str:
        return f"{self.root}/{BAGS}/{checksum_of([location.encode('utf-8', 'surrogateescape')])}.parquet"

    def _write(self, path: str, data: bytes) -> None:
        """Make a file that appears whole."""
        if self.local:
            parts = Path(self.root, _PARTS)
            for folder in (Path(path).parent, parts):
                folder.mkdir(parents=True, exist_ok=True)
            write_whole(path, data, parts)
            return
        try:
            with reaching(self.url):
                self.files.pipe_file(path, data)
        except FileNotFoundError as error:
            raise StorageError(f"store {self.url} cannot be written: {error}") from error

    def _add_to_month(self, month: Path, checksum: str, data: bytes) -> None:
        """Put the strokes of a bag, a Parquet file, in place of those that the month has of it."""
        own = month / f"{checksum}.parquet"
        if own.exists():
            self._write(str(own), data)
            return
        file = month / _MONTH
        with self._whole(file):
            content = _with_bag(file, checksum, data)
        self._write(str(file), content)

    @contextmanager
    def _whole(self, file: str | Path) -> Iterator[None]:
        """Raises HistoryError if what reads a ``file`` meanwhile finds it damaged."""
        try:
            yield
        except ValueError as error:
            remedy = "remove it, and add its bags again with --again"
            raise HistoryError(f"store {self.url}: {file} is damaged: {error}; {remedy}") from error


def _with_bag(file: Path, checksum: str, data: bytes) -> bytes:
    """The content of a month's file with the strokes ``data`` of a bag in place of those that it has of it."""
    import pyarrow
    import pyarrow.compute as compute

    strokes = rows_in(StrokeRow, data)
    if file.exists():
        there = rows_in(StrokeRow, file.read_bytes())
        others = there.filter(compute.not_equal(there["checksum"], checksum))
        strokes = pyarrow.concat_tables([others, strokes])
    return sealed(strokes.sort_by(_ORDER))
