"""Adds bags to a store, on as many cores as wanted. A bag gives the same bytes wherever it is evaluated."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import chain, islice
from pathlib import Path

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.record import MetricsError
from straightcomp_ros.bags import BagError, noting_warnings
from straightcomp_ros.bags.folder import found_files, split_number
from straightcomp_ros.bags.information import origin
from straightcomp_ros.bags.mcap_input import McapInput
from straightcomp_ros.fleet.history.bag_places import BagPlace, file_system, reaching
from straightcomp_ros.fleet.history.rows import BagRow, StrokeRow, checksum_of, parquet
from straightcomp_ros.fleet.history.store import Store
from straightcomp_ros.fleet.history.strokes_of_bag import date_of_zero, recorded_facts, rows_of
from straightcomp_ros.offline.workers import spread

_BLOCK = 1 << 20


@dataclass
class Tally:
    """How many bags were added, were known and unchanged, or were refused, and how many strokes those added have,
    new to the store or not."""

    added: int = 0
    known: int = 0
    refused: int = 0
    strokes: int = 0


def add(
    store: Store,
    places: Iterable[BagPlace],
    tally: Tally,
    *,
    again: bool = False,
    jobs: int = -1,
    dask: str = "",
    remap: Mapping[str, str] | None = None,
) -> Iterator[BagRow]:
    """Evaluate the bags that the store does not have as they are now, write what they give, each as soon as it is
    there, and give its row. Only this process writes: the workers need the bags, not the store.

    ``tally`` is counted up. ``again`` evaluates the bags that the store has, too. ``jobs`` and ``dask`` say where to
    evaluate, see :func:`straightcomp_ros.offline.workers.spread`. ``remap`` has the bags' topic for each of our topics
    that has another name there.

    Raises:
        WorkersError: the workers cannot be reached.
        OSError: the store cannot be written, or a folder not be listed.
    """
    # Under other names of topics a bag may not be refused.
    new = _unknown(store, places, tally, refused=not remap) if not again else iter(places)
    first = list(islice(new, 2))
    if not first:
        return
    # Other processes take longer to start than one bag takes.
    jobs = jobs if len(first) > 1 else 1
    for row, strokes, texts in spread(partial(_noted, remap=remap), (), chain(first, new), jobs=jobs, dask=dask):
        for text in texts:
            warnings.warn(text if row.location in text else f"{row.location}: {text}", stacklevel=2)
        # Before it is stored: Ctrl-C may end that, and all that is stored is counted.
        tally.strokes += row.strokes
        tally.added += row.reason is None
        tally.refused += row.reason is not None
        store.put(row, strokes)
        yield row


def _unknown(store: Store, places: Iterable[BagPlace], tally: Tally, refused: bool) -> Iterator[BagPlace]:
    for place in places:
        if store.has(place, refused):
            tally.known += 1
        else:
            yield place


def _noted(place: BagPlace, remap: Mapping[str, str] | None) -> tuple[BagRow, bytes | None, list[str]]:
    """As :func:`evaluated`, and each different warning: a worker's own would not name the bag, and come as Python's."""
    with noting_warnings() as texts:
        row, strokes = evaluated(place, remap)
    return row, strokes, texts


def evaluated(place: BagPlace, remap: Mapping[str, str] | None = None) -> tuple[BagRow, bytes | None]:
    """Evaluate a bag: its row, and its strokes as a Parquet file. One that cannot be evaluated is refused with the
    reason, whatever that is: among thousands of bags a single one must not end the work. ``remap`` has the bag's topic
    for each of ours with another name there."""
    row = BagRow(place.location, place.size, place.modified, evaluated_by=_this_program())
    try:
        with _on_this_machine(place) as bag:
            try:
                files, _ = found_files(bag)
                row = replace(row, checksum=checksum_of(block for file in files for block in _blocks(file)))
                _check_finished(bag, files)
                evaluation = evaluate_bag(bag, remap)
                stage, facts = recorded_facts(bag, str(row.checksum), evaluation)
                strokes = rows_of(evaluation, facts, date_of_zero(bag, evaluation.begin_ns))
                month = f"{strokes[0].start:%Y-%m}"
                data = parquet(StrokeRow, strokes)
                return replace(row, stage=stage, month=month, strokes=len(strokes)), data
            except (OSError, ImportError):
                raise
            except (BagError, MetricsError) as error:
                reason = str(error)
            except Exception as error:
                reason = f"cannot be evaluated: {type(error).__name__}: {error}; please report this bag"
            # Where a copy of a remote bag lay says nothing.
            return replace(row, reason=reason.replace(str(bag), row.location)), None
    except OSError as error:
        return replace(row, checksum=None, reason=f"cannot be read: {error.strerror or error}"), None


def _check_finished(bag: Path, files: Sequence[Path]) -> None:
    """Raise BagError for a bag that is being written or copied, or was cut off: its last stroke may be half a stroke,
    or more may follow."""
    for file in files:
        if file.suffix == ".mcap":
            with McapInput(file) as opened:
                if not opened.finished:
                    raise BagError(
                        f"bag {file} was not finished, or its end is damaged; save what is there with `straightcomp "
                        "recover`, and add that"
                    )
    of_one_mcap = len(files) == 1 and files[0].suffix == ".mcap"
    # A numbered file in a folder may be the first of several that are being copied.
    alone = of_one_mcap and (bag.is_file() or split_number(files[0])[1] < 0)
    if not (alone or files[0].with_name("metadata.yaml").exists()):
        raise BagError(
            f"bag {files[0]} was not finished: it has no metadata.yaml; when all its files are there, make it with "
            f"`ros2 bag reindex`, and add its folder"
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
        if place.names:
            bag.mkdir()
        with reaching(place.location):
            for name in place.names:
                files.get_file(f"{path}/{name}", str(bag / name))
            if not place.names:
                files.get_file(path, str(bag))
        yield bag


@cache
def _this_program() -> str:
    made_by = origin()
    return f"{made_by['version']} ({made_by['revision']})"
