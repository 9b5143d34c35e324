"""SQL over a store, by DuckDB."""

from __future__ import annotations

import glob
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from straightcomp_ros.fleet.history import HistoryError
from straightcomp_ros.fleet.history.rows import BIN_MM, PARTITIONS, BagRow, StrokeRow, schema_of
from straightcomp_ros.fleet.history.store import BAGS, STROKES, Store
from straightcomp_ros.parameters.output_files import same_or_within

if TYPE_CHECKING:
    import pyarrow

_VIEWS = f"""
CREATE VIEW refused AS SELECT location, size, modified, reason FROM bags WHERE reason IS NOT NULL;
CREATE VIEW bins AS
  SELECT stage, month, checksum, bag, stroke, start, direction, bins_from_mm + {BIN_MM} * (bin - 1) AS x_mm,
    error_bins_um[bin] AS error_um, residual_bins_um[bin] AS residual_um, current_bins_A[bin] AS current_A,
    guide_change_um[bin] AS guide_change_um
  FROM (SELECT *, unnest(range(1, len(error_bins_um) + 1)) AS bin FROM strokes);
"""


_WRITTEN = re.compile(r"\b(?:TO|DATABASE)\s+'((?:[^']|'')*)'", re.IGNORECASE)
"""The file or folder that COPY or EXPORT writes."""


def query(store: Store, sql: str, force: bool = False) -> pyarrow.Table:
    """What a query gives; a table without columns for a statement that gives nothing.

    Its tables are ``strokes``, with the columns of :class:`~straightcomp_ros.fleet.history.rows.StrokeRow` and its
    partitions, ``bags``, of :class:`~straightcomp_ros.fleet.history.rows.BagRow`, ``refused``, the bags among them
    that have no strokes in the store, and ``bins``, one row for each bin of each stroke.

    A file that COPY names is replaced with ``force`` only, and one of the store never.

    Raises:
        HistoryError: there is no store, or the query is refused.
    """
    import duckdb
    import pyarrow

    with duckdb.connect() as database:
        database.execute("SET TimeZone = 'UTC'")
        if not store.local:
            database.register_filesystem(store.files)
        if not _add_table(database, store, BAGS, BagRow, ()):
            make = f"straightcomp history add BAG -o {store.url}"
            raise HistoryError(f"store {store.url}: no bag was added there; make it: {make}")
        _add_table(database, store, STROKES, StrokeRow, PARTITIONS)
        database.execute(_VIEWS)
        try:
            for statement in database.extract_statements(sql):
                if statement.type != duckdb.StatementType.SELECT:
                    _keep_files(statement.query, store, force)
            found = database.sql(sql)
            return pyarrow.table({}) if found is None else found.to_arrow_table()
        except duckdb.Error as error:
            raise HistoryError(f"query: {' '.join(str(error).split())}") from error


def _keep_files(statement: str, store: Store, force: bool) -> None:
    for name in _WRITTEN.findall(statement):
        path = Path(name.replace("''", "'"))
        if store.local and same_or_within(path, Path(store.root)):
            raise HistoryError(f"query: '{path}' is in the store; name another file")
        if os.path.lexists(path) and not force and not path.is_char_device():
            raise HistoryError(f"query: '{path}' is there already; name another file, or give --force")


def _add_table(database: Any, store: Store, name: str, row: type, partitions: tuple[str, ...]) -> bool:
    """Add a table of the store; returns whether it has files."""
    folder = f"{store.root}/{name}"
    if not store.local:
        folder = store.files.unstrip_protocol(folder)
    files = f"{glob.escape(folder)}/**/*.parquet".replace("'", "''")
    if not database.execute(f"SELECT 1 FROM glob('{files}') LIMIT 1").fetchall():
        import pyarrow

        schema = pyarrow.schema([*schema_of(row), *((partition, pyarrow.string()) for partition in partitions)])
        database.register(name, schema.empty_table())
        return False
    # A stage named 1 is no number.
    types = ", ".join(f"'{partition}': VARCHAR" for partition in partitions)
    hive = f", hive_partitioning = true, hive_types = {{{types}}}" if partitions else ""
    database.execute(f"CREATE VIEW {name} AS SELECT * FROM read_parquet('{files}'{hive})")
    return True
