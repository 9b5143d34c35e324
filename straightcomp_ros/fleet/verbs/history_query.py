"""Ask a store in SQL, by DuckDB.

  straightcomp history query "SELECT stage, month, median(true_pp_um) FROM strokes GROUP BY ALL ORDER BY ALL"
  straightcomp history query "SELECT x_mm, avg(error_um) FROM bins WHERE direction = 'forward' GROUP BY x_mm"
  straightcomp history query "SELECT location, reason FROM refused"
  straightcomp history query "COPY (SELECT start, latency_p99_us FROM strokes ORDER BY start) TO 'latency.csv'"

Tables: `strokes`, one row for each stroke; `bins`, one row for each 10 mm of each stroke; `bags`, one row for each bag
that was added or refused; `refused`, those of them that were refused. `DESCRIBE strokes` lists the columns, which
docs/reference.md explains. Times are UTC. With --json the rows are the list `rows`.
"""

from __future__ import annotations

import argparse
from datetime import date
from typing import Any

from straightcomp_ros.cli.options import add_force
from straightcomp_ros.cli.output import console, print_json
from straightcomp_ros.cli.results import figures_table, shown, titled_table
from straightcomp_ros.fleet.verbs.history_add import DEFAULT_STORE

SUMMARY = "ask a store in SQL"
_MOST_COLUMNS = 12
"""Rows with more columns are printed one below the other: side by side no terminal has room for them."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("store", nargs="?", default=DEFAULT_STORE, metavar="STORE", help="folder or URL (default: %(default)s)")
    add("sql", metavar="SQL", help="the query")
    add_force(parser)
    add("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    from straightcomp_ros.fleet.history.queries import query
    from straightcomp_ros.fleet.history.store import Store

    found = query(Store(options.store), options.sql, options.force)
    rows = [{name: _plain(value) for name, value in row.items()} for row in found.to_pylist()]
    if options.json:
        print_json({"rows": rows})
    elif len(found.column_names) > _MOST_COLUMNS:
        for number, row in enumerate(rows, 1):
            console.print(figures_table(f"row {number} of {len(rows)}", row))
    elif found.column_names:
        left = {field.name for field in found.schema if not _is_number(field.type)}
        cells = ([shown(value) for value in row.values()] for row in rows)
        console.print(titled_table(f"rows: {len(rows)}", *found.column_names, left=left, rows=cells))


def _plain(value: Any) -> Any:
    """A value as JSON and tables have it: times as ISO 8601, other types that JSON lacks as texts."""
    if isinstance(value, list):
        return [_plain(one) for one in value]
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, date):
        return value.isoformat()
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _is_number(kind: Any) -> bool:
    from pyarrow import types

    return any(is_kind(kind) for is_kind in (types.is_integer, types.is_floating, types.is_decimal))
