"""A store: folders of Parquet files that any number of processes may add to at once.

    strokes/stage=NAME/month=YYYY-MM/strokes.parquet     all strokes of a stage's month
    bags/HASH.parquet                                    one row: the bag at the place whose hash this is

A month's file is a function of its bags alone, and is replaced as a whole under a lock, which the kernel takes from a
process that is killed. So processes that add the same bags write the same bytes, and a process that is killed leaves
nothing that the next one does not write again. The strokes are written before the row that says so.
"""

from __future__ import annotations

import glob
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, unquote

from straightcomp_ros.fleet.history import HistoryError
from straightcomp_ros.fleet.history.bag_places import BagPlace
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
    """A store in a folder. HistoryError: that is a file, or a URL."""

    def __init__(self, folder: str) -> None:
        import pyarrow  # noqa: F401 - if it is missing, that is reported before anything is evaluated

        self.folder = Path(folder)
        if "://" in folder or self.folder.is_file():
            what = "a URL" if "://" in folder else "a file"
            raise HistoryError(f"store {folder}: is {what}; name a folder")

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
            return rows_in(BagRow, self._bag_file(location).read_bytes()).to_pylist()[0]  # type: ignore[no-any-return]
        except (FileNotFoundError, ValueError, LookupError):
            return {}

    def put(self, row: BagRow, strokes: bytes | None) -> None:
        """Write the row of a bag, and its strokes, a Parquet file, if it has not been refused.

        Raises:
            OSError: the store cannot be written.
            HistoryError: the file of the bag's month is damaged.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with locked(self.folder / _LOCK):
            # Left by a process that was killed.
            for part in (self.folder / _PARTS).glob("*"):
                part.unlink()
            if strokes is not None:
                partitions = (f"{name}={quote(str(getattr(row, name)), safe='')}" for name in PARTITIONS)
                file = self.folder.joinpath(STROKES, *partitions, _MONTH)
                with self._whole(file):
                    content = _with_bag(file, str(row.checksum), strokes)
                self._write(file, content)
            self._write(self._bag_file(row.location), parquet(BagRow, [row]))

    def stages(self) -> list[str]:
        """Names of the stages, sorted."""
        folders = (self.folder / STROKES).glob("stage=*")
        return sorted(unquote(folder.name.removeprefix("stage=")) for folder in folders)

    def strokes(self, stage: str) -> pyarrow.Table:
        """The strokes of a stage, sorted by ``start``, ``checksum`` and ``stroke``. Raises HistoryError for a stage
        that the store does not have, or a damaged file."""
        import pyarrow

        folder = self.folder / STROKES / f"stage={quote(stored_name(stage), safe='')}"
        if not folder.is_dir():
            known = ", ".join(self.stages()) or "none"
            raise HistoryError(f"store {self.folder}: has no stage '{stage}'; its stages are: {known}")
        tables = [schema_of(StrokeRow).empty_table()]
        for file in folder.rglob("*.parquet"):
            with self._whole(file):
                tables.append(rows_in(StrokeRow, file.read_bytes()))
        return pyarrow.concat_tables(tables).sort_by(_ORDER)

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
            try:
                if not self._add_table(database, BAGS, BagRow, ()):
                    make = f"straightcomp history add BAG -o {self.folder}"
                    raise HistoryError(f"store {self.folder}: no bag was added there; make it: {make}")
                self._add_table(database, STROKES, StrokeRow, PARTITIONS)
                database.execute(_VIEWS)
                # A function in SELECT could name a file to write, too, as those of logging and profiling do.
                database.execute("SET lock_configuration = true")
                statements = database.extract_statements(sql)
                for statement in statements:
                    if statement.type != duckdb.StatementType.SELECT:
                        raise HistoryError(f"query: {statement.type.name} is not allowed; allowed: SELECT")
                if not statements:
                    raise HistoryError("query: there is none; allowed: SELECT")
                return database.sql(sql).to_arrow_table()
            except duckdb.Error as error:
                raise HistoryError(f"query: {' '.join(str(error).split())}") from error

    def _add_table(self, database: Any, name: str, row: type, partitions: tuple[str, ...]) -> bool:
        """Add a table of the store; returns whether it has files."""
        import pyarrow

        folder = self.folder / name
        found = False
        # DuckDB takes damaged values for values.
        for file in folder.rglob("*.parquet"):
            found = True
            with self._whole(file):
                check_seal(file.read_bytes())
        files = f"{glob.escape(str(folder))}/**/*.parquet".replace("'", "''")
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

    def _bag_file(self, location: str) -> Path:
        return self.folder / BAGS / f"{checksum_of([location.encode('utf-8', 'surrogateescape')])}.parquet"

    def _write(self, path: Path, data: bytes) -> None:
        """Make a file that appears whole."""
        parts = self.folder / _PARTS
        for folder in (path.parent, parts):
            folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, data, parts)

    @contextmanager
    def _whole(self, file: Path) -> Iterator[None]:
        """Raises HistoryError if what reads a ``file`` meanwhile finds it damaged."""
        try:
            yield
        except ValueError as error:
            remedy = "remove it, and add its bags again with --again"
            raise HistoryError(f"store {self.folder}: {file} is damaged: {error}; {remedy}") from error


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
