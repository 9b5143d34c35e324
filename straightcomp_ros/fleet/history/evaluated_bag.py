"""What one bag gives to a store, as bytes: the same bytes for the same bag, wherever it is evaluated."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.record import MetricsError
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.folder import found_files
from straightcomp_ros.bags.information import origin
from straightcomp_ros.bags.mcap_input import McapInput
from straightcomp_ros.fleet.history import HistoryError
from straightcomp_ros.fleet.history.bag_places import BagPlace, file_system, reaching
from straightcomp_ros.fleet.history.bag_row import BagRow
from straightcomp_ros.fleet.history.recorded_facts import checksum_of, recorded_facts
from straightcomp_ros.fleet.history.row_columns import table_of
from straightcomp_ros.fleet.history.stroke_row import StrokeRow
from straightcomp_ros.fleet.history.strokes_of_bag import rows_of

_BLOCK = 1 << 20


class EvaluatedBag(NamedTuple):
    """The row of a bag, and its strokes as a Parquet file; None for a refused bag."""

    row: BagRow
    strokes: bytes | None


def evaluated(place: BagPlace, remap: Mapping[str, str] | None = None) -> EvaluatedBag:
    """Evaluate a bag. One that cannot be evaluated is refused with the reason, whatever that is: among thousands of
    bags a single one must not end the work. ``remap`` has the bag's topic for each of ours with another name there."""
    row = BagRow(
        location=place.location,
        size=place.size,
        modified=place.modified,
        checksum=None,
        stage=None,
        month=None,
        strokes=0,
        reason=None,
        evaluated_by=_this_program(),
    )
    try:
        with _on_this_machine(place) as bag:
            return _evaluated(bag, row, remap)
    except OSError as error:
        return EvaluatedBag(replace(row, reason=f"cannot be read: {error.strerror or error}"), None)


def parquet(row: type, rows: Sequence[Any]) -> bytes:
    """Rows of the class ``row`` as a Parquet file."""
    import pyarrow.parquet

    file = io.BytesIO()
    # Columns are short: what describes them would be three times as long as they are.
    pyarrow.parquet.write_table(
        table_of(row, rows), file, compression="zstd", use_dictionary=False, store_schema=False, write_statistics=False
    )
    return file.getvalue()


def _evaluated(bag: Path, row: BagRow, remap: Mapping[str, str] | None) -> EvaluatedBag:
    try:
        files, _ = found_files(bag)
        row = replace(row, checksum=checksum_of(block for file in files for block in _blocks(file)))
        _check_finished(files)
        evaluation = evaluate_bag(bag, remap)
        facts = recorded_facts(bag, str(row.checksum), evaluation)
        strokes = rows_of(evaluation, facts)
        data = parquet(StrokeRow, strokes)
    except (OSError, HistoryError):
        raise
    except (BagError, MetricsError) as error:
        reason = str(error)
    except Exception as error:
        reason = f"cannot be evaluated: {type(error).__name__}: {error}; please report this bag"
    else:
        month = f"{strokes[0].start:%Y-%m}"
        row = replace(row, stage=facts.stage, month=month, strokes=len(strokes))
        return EvaluatedBag(row, data)
    # Where a copy of a remote bag lay says nothing.
    return EvaluatedBag(replace(row, reason=reason.replace(str(bag), row.location)), None)


def _check_finished(files: Sequence[Path]) -> None:
    """Raise BagError for a bag that is being written or was cut off: its last stroke may be half a stroke."""
    for file in files:
        if file.suffix == ".mcap":
            with McapInput(file) as opened:
                if opened.summary is None:
                    raise BagError(
                        f"bag {file} was not finished, or its end is damaged; save what is there with `straightcomp "
                        "recover`, and add that"
                    )


def _blocks(file: Path) -> Iterator[bytes]:
    with file.open("rb") as opened:
        while block := opened.read(_BLOCK):
            yield block


@contextmanager
def _on_this_machine(place: BagPlace) -> Iterator[Path]:
    """The bag itself, or a temporary copy of one that lies elsewhere."""
    files, path, local = file_system(place.location)
    if local:
        yield Path(path)
        return
    with tempfile.TemporaryDirectory(prefix="straightcomp_history_") as folder:
        bag = Path(folder, Path(path).name)
        with reaching(place.location):
            if place.names:
                bag.mkdir()
            for name in place.names:
                files.get_file(f"{path}/{name}", str(bag / name))
            if not place.names:
                files.get_file(path, str(bag))
        yield bag


@cache
def _this_program() -> str:
    made_by = origin()
    return f"{made_by['version']} ({made_by['revision']})"
