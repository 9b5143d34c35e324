"""What the verbs that read a store of strokes share: which stages, from which day on."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from datetime import date, datetime, time, timezone
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from straightcomp_ros.cli.options import add_repeatable
from straightcomp_ros.cli.output import CommandFailed
from straightcomp_ros.fleet.verbs.history_add import DEFAULT_STORE

if TYPE_CHECKING:
    import pyarrow


def add_stages(parser: argparse.ArgumentParser) -> None:
    """Declare the store, ``--stage`` and ``--since``."""
    add = parser.add_argument
    add("store", nargs="?", default=DEFAULT_STORE, metavar="STORE", help="folder or URL (default: %(default)s)")
    add_repeatable(parser, "--stage", "NAME", "only this stage")
    since = (
        "strokes from this day on, YYYY-MM-DD: that after the last maintenance, whose first four weeks are the measure"
    )
    add("--since", type=_day, metavar="DATE", help=since)


def _day(text: str) -> date:
    try:
        return date.fromisoformat(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r}; allowed: a date as 2026-11-24") from error


def stored_stages(options: argparse.Namespace, columns: Sequence[str]) -> Iterator[tuple[str, pyarrow.Table]]:
    """Each chosen stage with its strokes; CommandFailed where there are none."""
    from straightcomp_ros.fleet.history.store import Store

    store = Store(options.store)
    names = options.stage or store.stages()
    if not names:
        raise CommandFailed(f"store {options.store} has no strokes; fill it by `straightcomp history add`")
    for name in names:
        strokes = since(store.strokes(name, list(columns)), options.since)
        if not strokes.num_rows:
            raise CommandFailed(f"stage '{name}' has no strokes since {options.since}")
        yield name, strokes


def since(strokes: Any, day: date | None) -> Any:
    """The strokes (a pyarrow table) from the beginning of a day on, UTC."""
    if day is None:
        return strokes
    import pyarrow.compute

    begin = datetime.combine(day, time.min, timezone.utc)
    return strokes.filter(pyarrow.compute.greater_equal(strokes["start"], begin))


def file_of(stage: str, ending: str) -> str:
    """Name of a stage's file: a stage may be called anything."""
    from straightcomp_ros.fleet.history.recorded_facts import stored_name

    return f"{quote(stored_name(stage), safe=' ')}{ending}"
