"""The folder of a stage's month on a local disk: a file for each bag, and one for all bags that were compacted.

Compacting exchanges the folder for a new one in one step of the file system: whoever reads, and whoever kills, finds
all strokes once, in the old files or in the new one. Writers wait for that moment by a lock, which the kernel takes
from a process that is killed. A bag that is evaluated again after that changes its rows in the compacted file.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from straightcomp_ros.fleet.history.recorded_facts import checksum_of
from straightcomp_ros.fleet.history.row_columns import schema_of
from straightcomp_ros.fleet.history.stroke_row import StrokeRow
from straightcomp_ros.parameters.output_files import exchange, locked, write_whole

if TYPE_CHECKING:
    import pyarrow

_COMPACTED = "compacted-{}.parquet"
"""With the checksum of its content: whoever listed the folder before an exchange finds no file of that name, instead of
another one that has strokes twice that he has read already."""
KEYS = [(name, "ascending") for name in ("start", "checksum", "stroke")]
"""Order of the strokes of a stage."""
_LOCK = ".lock"


@contextmanager
def alone(root: Path) -> Iterator[None]:
    """Wait until no other process writes strokes to the store in ``root``, which is there, and keep them waiting."""
    with locked(root / _LOCK):
        yield


def write_bag(month: Path, checksum: str, data: bytes, parts: Path) -> None:
    """Write the strokes of a bag, a Parquet file, through the folder ``parts``. Only with :func:`alone`."""
    import pyarrow
    import pyarrow.compute as compute
    import pyarrow.parquet as parquet

    compacted = next(month.glob(_COMPACTED.format("*")), None)
    if compacted is not None and _has(compacted, checksum):
        there = _table([compacted])
        ours = compute.equal(there["checksum"], checksum)
        new = parquet.read_table(pyarrow.BufferReader(data), schema=there.schema)
        if there.filter(ours).equals(new):
            return
        kept = there.filter(compute.invert(ours))
        write_whole(compacted, _file_of(pyarrow.concat_tables([kept, new])), parts)
    else:
        write_whole(month / f"{checksum}.parquet", data, parts)


def compact(month: Path, part: Path) -> int:
    """Make one file of all files of a month; returns how many there were, 0 where one is all. Only with :func:`alone`.

    Args:
        month: the folder.
        part: of a new folder on the same file system; what a killed process leaves there is to be removed.

    Raises:
        OSError: a file cannot be read or written, or the file system cannot exchange folders.
        pyarrow.ArrowException: a file is damaged.
    """
    files = sorted(month.glob("*.parquet"))
    if not files or (len(files) == 1 and files[0].match(_COMPACTED.format("*"))):
        return 0
    part.mkdir()
    try:
        data = _file_of(_table(files))
        # On the disk when this returns. The old files go next: a power failure must leave either.
        write_whole(part / _COMPACTED.format(checksum_of([data])), data)
        for other in month.iterdir():
            if other not in files:
                os.link(other, part / other.name)
        exchange(month, part)
    finally:
        # The old files, or a new one that did not come to be.
        shutil.rmtree(part, ignore_errors=True)
    return len(files)


def _has(file: Path, checksum: str) -> bool:
    import pyarrow.parquet

    found = pyarrow.parquet.read_table(file, columns=["checksum"], filters=[("checksum", "=", checksum)])
    return bool(found.num_rows)


def _table(files: list[Path]) -> pyarrow.Table:
    import pyarrow.dataset

    return pyarrow.dataset.dataset([str(file) for file in files], schema_of(StrokeRow), format="parquet").to_table()


def _file_of(strokes: pyarrow.Table) -> bytes:
    import pyarrow.parquet

    out = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(strokes.sort_by(KEYS), out, compression="zstd", store_schema=False)
    return out.getvalue().to_pybytes()  # type: ignore[no-any-return]
