"""The rows of a store: a table's columns are the fields of a dataclass, each declared once.

Figures have the names and units of `straightcomp evaluate --json`. A figure that the bag does not hold is null.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

if TYPE_CHECKING:
    import pyarrow

BIN_MM = 10
"""Width of the bins over x. Bin k of a stroke begins at ``bins_from_mm`` + 10 k."""
PARTITIONS = ("stage", "month")
"""Columns that the folders of the store name, so that a file does not repeat them: name of the stage, and month
YYYY-MM in which the bag's first stroke began, UTC."""
_SEAL, _UNSEALED = b"blake2b:", b"0" * 48
"""What stands before the checksum and the size of the whole in a file's footer, and in their place while they are not
known: Parquet's own checksums leave the footer out, and DuckDB does not look at them."""
_LONGEST_NAME = 240
"""Bytes; file systems allow 255, of which `stage=` or `.html.part` take some."""


def column(description: str, default: Any = dataclasses.MISSING) -> Any:
    """Declare a column: a field of a row, nullable if its type allows None; the unit is at the end of its name."""
    kw_only = default is not dataclasses.MISSING
    return dataclasses.field(default=default, kw_only=kw_only, metadata={"description": description})


@dataclass(frozen=True)
class BagRow:
    """The row. A copy of a bag at another place is another row with the same checksum, and no more strokes."""

    location: str = column("full path or URL of the bag")
    size: int = column("bytes of its files")
    modified: datetime | None = column("when the newest of its files was changed, UTC")
    checksum: str | None = column("BLAKE2b of its files; null if they could not be read", None)
    stage: str | None = column("name of the stage; null for a refused bag", None)
    month: str | None = column("month of its strokes, YYYY-MM; null for a refused bag", None)
    strokes: int = column("number of its strokes in the table strokes", 0)
    reason: str | None = column("why its strokes are not in the store; null if they are", None)
    evaluated_by: str = column("version of the package that evaluated it", "")


@dataclass(frozen=True)
class StrokeRow:
    """The row; its partition is (stage, month)."""

    checksum: str = column("BLAKE2b of the bag's files: the bag's key, the same wherever the bag lies", "")
    bag: str = column("name under which the bag was recorded", "")
    stroke: int = column("number of the stroke in its bag, from 1")
    start: datetime = column("when the stroke began, UTC, by the stamps of the samples")
    identity: str | None = column("name and checksum of the stage's description", None)
    law: str = column("control law")
    direction: str = column("forward or backward")
    duration_s: float = column("duration of the stroke")
    travel_mm: float = column("its travel in x")
    encoder_pp_um: float = column("compensation error r − y as the encoder sees it, p-p")
    encoder_rms_um: float = column("the same, RMS about zero")
    true_pp_um: float | None = column("true compensation error, p-p; simulated machines only")
    true_rms_um: float | None = column("the same, RMS about zero")
    before_least_squares_um: float = column("straightness of the guide about the least squares line (ISO 230-1)")
    before_end_points_um: float = column("the same about the line through the end points")
    after_least_squares_um: float = column("straightness of the workpiece about the least squares line")
    after_end_points_um: float = column("the same about the line through the end points")
    before_minimum_zone_um: float | None = column(
        "width of the guide's minimum zone (ISO 230-1); null in a row of an earlier version", None
    )
    after_minimum_zone_um: float | None = column("the same of the workpiece", None)
    before_least_squares_U_um: float | None = column(
        "expanded uncertainty (k = 2) of before_least_squares_um as the mean of the bag's strokes in this direction, "
        "of the contributions that are known (docs/accuracy.md); null where none is",
        None,
    )
    before_end_points_U_um: float | None = column("the same of before_end_points_um", None)
    before_minimum_zone_U_um: float | None = column("the same of before_minimum_zone_um", None)
    after_least_squares_U_um: float | None = column("the same of after_least_squares_um", None)
    after_end_points_U_um: float | None = column("the same of after_end_points_um", None)
    after_minimum_zone_U_um: float | None = column("the same of after_minimum_zone_um", None)
    settling_s: float | None = column(
        "time from the stroke's end until the error stays within ±0.1 µm up to the next stroke; null if it does not",
        None,
    )
    standstill_pp_um: float | None = column("error after that, or at rest where it does not settle, p-p", None)
    standstill_rms_um: float | None = column("the same, RMS about zero", None)
    reversal_pp_um: float | None = column(
        "error in 0.1 s before and after the reversal that follows the stroke, p-p; null without one", None
    )
    control_activity_A: float = column("Σ |Δi_c| of the commands")
    coil_work_A2s: float = column("∫ i_c² dt of the commands: heat in the coils for each ohm")
    friction_A: float | None = column("friction as current: half the hysteresis of the coil current over y")
    stiffness_A_per_m: float | None = column("slope of the coil current over y: K̄_y / K̄_i")
    amplifier_bandwidth_Hz: float | None = column("bandwidth of the amplifier")
    latency_p50_us: float | None = column("time from a sample to the arrival of its command, median")
    latency_p99_us: float | None = column("the same, 99th percentile")
    expected_samples: int = column("samples that the clock took during the stroke")
    lost_samples: int = column("of these, samples that the bag lacks")
    unanswered_samples: int = column("samples in the bag without reference or command")
    saturated_samples: int = column("samples with the command at the current limit")
    amplifier_off_samples: int = column("samples with the amplifier off")
    stick_slip_events: int = column("how often the platform stuck and slipped")
    faults: list[str] = column("faults of the driver latched in the stroke or before the next one, see docs/safety.md")
    verdict: str = column("verdict on the stroke, see docs/accuracy.md")
    reason: str = column("the verdict's reason, with numbers")
    bins_from_mm: int = column("x at which the first bin begins, a multiple of the bins' width of 10 mm")
    error_bins_um: list[float | None] = column("mean error r − y in each bin; null without a sample there")
    residual_bins_um: list[float | None] = column(
        "mean deviation of the workpiece in each bin, about the least squares line: true positions where they are "
        "known, else the map's and the encoder's"
    )
    current_bins_A: list[float | None] = column("mean command i_c in each bin")
    guide_change_um: list[float | None] | None = column(
        "deviation of the guide by the displacement sensor, minus the map's, in each bin; null without a sensor"
    )
    parameters_checksum: str | None = column("BLAKE2b of the parameters of driver, feedforward and controller", None)
    map_checksum: str | None = column("BLAKE2b of the attached map", None)
    software_version: str | None = column("version of the package that recorded the bag", None)
    software_revision: str | None = column("its git revision", None)
    host: str | None = column("computer that recorded the bag", None)


def is_nullable(one: dataclasses.Field[Any]) -> bool:
    """Whether a column may be null."""
    return str(one.type).endswith(" | None")


@functools.cache
def schema_of(row: type) -> pyarrow.Schema:
    """The Arrow schema of a row's class."""
    import pyarrow as pa

    types = {
        "str": pa.string(),
        "int": pa.int64(),
        "float": pa.float64(),
        "datetime": pa.timestamp("us", tz="UTC"),
        "list[str]": pa.list_(pa.string()),
        # Bins are many, and a µm needs no more than seven digits.
        "list[float | None]": pa.list_(pa.float32()),
    }
    columns = dataclasses.fields(row)
    return pa.schema(
        [pa.field(one.name, types[one.type.removesuffix(" | None")], nullable=is_nullable(one)) for one in columns]
    )


def table_of(row: type, rows: Sequence[Any]) -> pyarrow.Table:
    """The rows, instances of the class ``row``, as an Arrow table."""
    import pyarrow

    schema = schema_of(row)
    columns = {name: [_in_utf8(getattr(one, name)) for one in rows] for name in schema.names}
    return pyarrow.Table.from_pydict(columns, schema)


def parquet(row: type, rows: Sequence[Any]) -> bytes:
    """Rows of the class ``row`` as a Parquet file."""
    # Columns are short: what describes them would be three times as long as they are.
    return sealed(table_of(row, rows), use_dictionary=False, write_statistics=False)


def sealed(table: pyarrow.Table, **options: Any) -> bytes:
    """A table as a Parquet file whose footer has the checksum of the whole file, by which damage is seen."""
    import pyarrow.parquet

    file = io.BytesIO()
    with pyarrow.parquet.ParquetWriter(file, table.schema, compression="zstd", store_schema=False, **options) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({"checksum": _SEAL + _UNSEALED})
    return _with_checksum(file.getvalue())


def check_seal(data: bytes) -> None:
    """Raise ValueError for a Parquet file that is not as it was written. One of another size was written by another
    program, which copies the mark; earlier versions wrote none."""
    _, seal, tail = data.rpartition(_SEAL)
    size = tail[len(_UNSEALED) - 16 : len(_UNSEALED)]
    if seal and size == b"%016x" % len(data) and data != _with_checksum(data):
        raise ValueError("its content does not have the checksum that it was written with")


def _with_checksum(data: bytes) -> bytes:
    head, seal, tail = data.rpartition(_SEAL)
    tail = tail[len(_UNSEALED) :]
    return b"".join((head, seal, checksum_of((head, tail)).encode(), b"%016x" % len(data), tail))


def rows_in(row: type, data: bytes) -> pyarrow.Table:
    """The rows of a Parquet file, with the columns of the class ``row``: null where it was written before a column was
    declared. Raises ValueError for a damaged file.

    Read in this thread alone. ``pyarrow.parquet.read_table`` leaves a task to a thread of Arrow's pool, which may let
    go of ``data`` when the interpreter has ended, and aborts the process then (apache/arrow#34314).
    """
    import pyarrow.parquet

    check_seal(data)
    try:
        found = pyarrow.parquet.ParquetFile(pyarrow.BufferReader(data)).read(use_threads=False)
        schema, there = schema_of(row), set(found.column_names)
        columns = [
            found[field.name].cast(field.type) if field.name in there else pyarrow.nulls(found.num_rows, field.type)
            for field in schema
        ]
        return pyarrow.Table.from_arrays(columns, schema=schema)
    except (pyarrow.ArrowException, OSError) as error:  # the bytes are in memory: no file failed
        raise ValueError(" ".join(str(error).split())) from error


def checksum_of(parts: Iterable[bytes]) -> str:
    """BLAKE2b of these bytes, one after the other, 128 bits in hexadecimal."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        digest.update(part)
    return digest.hexdigest()


def stored_name(stage: str) -> str:
    """The name of a stage in a store, where it names a folder and files: the name itself, or where that is too long for
    a file system once it is quoted, its beginning with a checksum of all of it."""
    if len(quote(stage, safe="")) <= _LONGEST_NAME:
        return stage
    end = f"~{checksum_of([stage.encode('utf-8', 'backslashreplace')])[:12]}"
    kept = stage
    while len(quote(kept + end, safe="")) > _LONGEST_NAME:
        kept = kept[:-1]
    return kept + end


def _in_utf8(value: Any) -> Any:
    """A text that Parquet can hold: names of files need not be UTF-8."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value
