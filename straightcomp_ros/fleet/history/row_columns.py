"""How a row of the store is declared once: a dataclass whose fields are the columns of a table."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, get_type_hints

from straightcomp_ros.fleet.history import HistoryError

if TYPE_CHECKING:
    import pyarrow

_DESCRIPTION = "description"


class Column(NamedTuple):
    """A column: its name, the type of its values as in the dataclass, and what it means."""

    name: str
    kind: str
    description: str

    @property
    def nullable(self) -> bool:
        """Whether it may be null."""
        return self.kind.endswith("| None")


def column(description: str) -> Any:
    """Declare a field of a row; the unit is at the end of the field's name."""
    return dataclasses.field(metadata={_DESCRIPTION: description})


@functools.cache
def columns_of(row: type) -> tuple[Column, ...]:
    """The columns of a row's class, in their order."""
    return tuple(Column(one.name, str(one.type), one.metadata[_DESCRIPTION]) for one in dataclasses.fields(row))


@functools.cache
def schema_of(row: type) -> pyarrow.Schema:
    """The Arrow schema of a row's class. A column whose type allows None is nullable."""
    pa = arrow()
    types = {
        str: pa.string(),
        int: pa.int64(),
        float: pa.float64(),
        list[str]: pa.list_(pa.string()),
        # Bins are many, and a µm needs no more than seven digits.
        list[float | None]: pa.list_(pa.float32()),
    }
    hints = get_type_hints(row)
    fields = []
    for one in columns_of(row):
        kinds = [kind for kind in getattr(hints[one.name], "__args__", ()) if kind is not type(None)]
        kind = kinds[0] if one.nullable else hints[one.name]
        values = types.get(kind) or pa.timestamp("us", tz="UTC")
        fields.append(pa.field(one.name, values, nullable=one.nullable))
    return pa.schema(fields)


def table_of(row: type, rows: Sequence[Any]) -> pyarrow.Table:
    """The rows, instances of the class ``row``, as an Arrow table."""
    schema = schema_of(row)
    columns = {name: [_in_utf8(getattr(one, name)) for one in rows] for name in schema.names}
    return arrow().Table.from_pydict(columns, schema)


def _in_utf8(value: Any) -> Any:
    """A text that Parquet can hold: names of files need not be UTF-8."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def arrow() -> Any:
    """The package pyarrow; HistoryError where it is not installed."""
    try:
        import pyarrow
    except ImportError as error:
        remedy = "pip install 'straightcomp_ros[history]'"
        raise HistoryError(f"the history needs pyarrow, which is not installed. Remedy: {remedy}") from error
    return pyarrow
