"""Tools for months of machines: the figures of every stroke of every bag in one store.

A store is a folder of Parquet files, which pandas, Polars and DuckDB read too. The default is `history` in the working
directory.
"""

from __future__ import annotations

import argparse
import os
import shlex
import time
from collections.abc import Iterable, Iterator
from contextlib import nullcontext, suppress
from dataclasses import asdict
from datetime import date, datetime, timezone
from decimal import Decimal
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from straightcomp_ros.cli import Tool
from straightcomp_ros.cli.evaluate import add_remap_option, parsed_remap
from straightcomp_ros.cli.options import (
    PICTURES,
    add_dask,
    add_force,
    add_guide_option,
    add_json,
    add_repeatable,
    chosen_guide,
    in_range,
    output_file,
    output_folder,
)
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, print_written, progress_bar
from straightcomp_ros.cli.results import figures_table, shown, titled_table

if TYPE_CHECKING:
    import pyarrow

SUMMARY = "the figures of many bags in one store, and questions to it"
PURPOSE = "fleet"
_STORE, _STORE_HELP = "history", "folder (default: %(default)s)"


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("bags", nargs="+", metavar="BAG", help="rosbag2 folder, MCAP or SQLite file, or a folder of bags")
    add("--store", "-o", default=_STORE, metavar="STORE", help=_STORE_HELP)
    add("--jobs", type=in_range(int, 1), metavar="N", help="processes on this machine (default: all cores)")
    add_dask(parser)
    add("--again", action="store_true", help="evaluate bags that the store has, too: after an update of this program")
    add("--follow", action="store_true", help="go on until Ctrl-C, adding each new bag when two looks find it alike")
    wait = "with --follow: seconds between two looks (default: %(default)g)"
    add("--every", type=in_range(float, 0.1, 86_400.0, "s"), default=10.0, metavar="S", help=wait)
    add_remap_option(parser)
    add_json(parser)


def _add(options: argparse.Namespace) -> None:
    """Add the figures of each stroke of each bag to a store.

    A bag that the store has, unchanged, costs nothing, so the same command may run every hour, and after a kill or a
    failure. Several processes may add to one store at once. Bags may be URLs of any kind that fsspec knows, for example
    s3://bucket/folder.

    A bag that was cut off, is damaged or has no stroke is refused: the store's table `refused` says why. Among the bags
    of a folder there are such ones; the exit code is 1 if a bag that was named itself was refused, now or before, or if
    no other bag was there.
    """
    from straightcomp_ros.fleet.history.adding import Tally, add
    from straightcomp_ros.fleet.history.bag_places import GrowingFolders, bags_in
    from straightcomp_ros.fleet.history.store import Store

    remap = parsed_remap(options.remap)
    store, tally, growing = Store(options.store), Tally(), GrowingFolders()
    named = set()
    for url in options.bags:
        first = next(bags_in(url), None)
        if first is not None:
            named |= {first.location} & {url.rstrip("/"), os.path.abspath(url)}
        elif not options.follow:
            raise CommandFailed(f"{url}: no bag is there; allowed: a bag, or a folder with bags below it", exit_code=2)
    workers = {"jobs": options.jobs or -1, "dask": options.dask}
    # Ctrl-C is the usual end of --follow.
    with progress_bar() as bar, suppress(KeyboardInterrupt) if options.follow else nullcontext():
        task = bar.add_task("looking for bags", total=None)
        while True:
            found = chain.from_iterable(map(bags_in, options.bags))
            places = growing.resting(found) if options.follow else found
            for row in add(store, places, tally, again=options.again, remap=remap, **workers):
                bar.update(task, description=f"{tally.added} bags with {tally.strokes} strokes")
                if row.reason is not None:
                    notes.print(f"refused: {row.reason}")
                if row.checksum is None:
                    growing.retry(row)
            if not options.follow:
                break
            time.sleep(options.every)
    if options.json:
        print_json({"store": options.store, **asdict(tally)})
    else:
        counts = f"added {tally.added}, known and unchanged {tally.known}, refused {tally.refused}"
        console.print(f"{options.store}: bags {counts}; strokes in those added: {tally.strokes}")
    why = f'straightcomp history query {shlex.quote(options.store)} "SELECT location, reason FROM refused"'
    refused = [bag for bag in named if store.row(bag).get("reason")]
    if refused or (tally.refused and not tally.added + tally.known):
        raise CommandFailed(f"bags refused: {len(refused) or tally.refused}; the reasons: {why}")
    if not options.json:
        then = f"straightcomp history advise {shlex.quote(options.store)}"
        print_written(options.store, then=f"{then}; why bags were refused: {why}" if tally.refused else then)


def _query_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("store", nargs="?", default=_STORE, metavar="STORE", help=_STORE_HELP)
    add("sql", metavar="SQL", help="the query")
    add_json(parser)


def _query(options: argparse.Namespace) -> None:
    """Ask a store in SQL, by DuckDB.

      straightcomp history query "SELECT stage, month, median(true_pp_um) FROM strokes GROUP BY ALL ORDER BY ALL"
      straightcomp history query "SELECT x_mm, avg(error_um) FROM bins WHERE direction = 'forward' GROUP BY x_mm"
      straightcomp history query "SELECT location, reason FROM refused"

    Tables: `strokes`, one row for each stroke; `bins`, one row for each 10 mm of each stroke; `bags`, one row for each
    bag that was added or refused; `refused`, those of them that were refused. `DESCRIBE strokes` lists the columns,
    which docs/reference.md explains. A query only reads. Times are UTC. With --json the rows are the list `rows`.
    """
    from pyarrow import types

    from straightcomp_ros.fleet.history.store import Store

    found = Store(options.store).query(options.sql)
    rows = found.to_pylist()
    if options.json:
        print_json({"rows": rows}, _in_json)
    else:
        numbers = (types.is_integer, types.is_floating, types.is_decimal)
        left = {field.name for field in found.schema if not any(is_kind(field.type) for is_kind in numbers)}
        below = ([shown(value) for value in row.values()] for row in rows)
        console.print(titled_table(f"rows: {len(rows)}", *found.column_names, left=left, rows=below))


def _in_json(value: Any) -> Any:
    """What JSON has in the place of a value that it has no word for; a sum of integers is a decimal in DuckDB."""
    if isinstance(value, Decimal):
        return float(value) if value.as_tuple().exponent else int(value)
    return value.isoformat() if isinstance(value, date) else str(value)


def _advise_arguments(parser: argparse.ArgumentParser) -> None:
    _add_stages(parser)
    parser.add_argument("--output", "-o", metavar="DIR", help="write STAGE.json for each stage into this folder")
    add_force(parser)
    add_json(parser)


def _advise(options: argparse.Namespace) -> None:
    """Say what changed on each stage of a store, since when, the likely cause and what helps.

    Levels of days are compared with those of the first four weeks, so that a stage needs five weeks of strokes. After
    maintenance give its day by --since. With -o a small JSON file for each stage is written, which the live view
    (`straightcomp view --maintenance FILE`) and the OPC UA gateway (parameter `maintenance_file`, alarm MaintenanceDue)
    show: run it once a day.
    """
    from straightcomp_ros.fleet.maintenance.advice import advice_json, advice_of
    from straightcomp_ros.fleet.maintenance.day_levels import BASELINE, day_levels
    from straightcomp_ros.parameters.output_files import json_text

    folder = output_folder("--output", options.output) if options.output else None
    contents: dict[str, Any] = {}
    for stage, strokes in _stored_stages(options):
        levels = day_levels(strokes)
        days = len(levels.day)
        advice = advice_of(levels)
        contents[stage] = advice_json(stage, levels.date(-1), advice)
        if options.json:
            continue
        if days <= BASELINE:
            notes.print(f"{stage}: days with strokes: {days}; allowed: > {BASELINE}, the baseline")
            continue
        due = sum(one.due for one in advice)
        matters, style = (f"matters: {due}", "yellow") if due else ("nothing to do", "green")
        console.print(f"{stage}, {days} days until {levels.date(-1)}: {matters}", style=style)
        for one in advice:
            what = one.remedy if one.due else "nothing: it is back where it was"
            console.print(f"  found {one.found}: {one.text}\n    → {what}")
    if folder is not None:
        texts = ((stage, json_text(one)) for stage, one in contents.items())
        files = _written(folder, ".json", contents, texts, options.force)
        if not options.json:
            first = next(iter(files.values()))
            print_written(*files.values(), then=f"straightcomp view --maintenance {shlex.quote(str(first))}")
    if options.json:
        print_json({"stages": contents})


def _report_arguments(parser: argparse.ArgumentParser) -> None:
    _add_stages(parser)
    parser.add_argument("--output", "-o", metavar="DIR", default="report", help="folder (default: %(default)s)")
    add_force(parser)
    add_json(parser)


def _report(options: argparse.Namespace) -> None:
    """Write a report of each stage of a store: one HTML file that needs no network.

    Advice with its evidence, trends of all figures, the error over x and time, faults, and the bags to look at.
    """
    from straightcomp_ros.fleet.maintenance.stage_report import stage_report

    folder = output_folder("--output", options.output)
    # What may not be replaced, or is damaged, is known before a page is written; one page at a time is in memory.
    options.name = [stage for stage, _ in _stored_stages(options)]
    pages = ((stage, stage_report(stage, strokes)) for stage, strokes in _stored_stages(options))
    files = _written(folder, ".html", options.name, pages, options.force)
    if not options.json:
        for stage, file in files.items():
            console.print(f"{stage}: {file}")
        print_written(*files.values(), then="open it in a browser")
    else:
        print_json({"reports": {stage: str(file) for stage, file in files.items()}})


def _map_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("store", metavar="STORE", help="folder")
    add("name", metavar="NAME", help="name of the stage")
    add("--survey", required=True, metavar="FILE", help="the survey that the strokes used")
    add("--output", "-o", metavar="FILE", help="write the proposed map (CSV); without it nothing is written")
    add_force(parser)
    days = "before the last stroke (default: %(default)g)"
    add("--days", type=in_range(float, 0.01, 3650.0), default=7.0, metavar="N", help=days)
    add("--plot", metavar="FILE", help="also save a plot (PNG, SVG or PDF)")
    add_guide_option(parser)
    add_json(parser)


def _map(options: argparse.Namespace) -> None:
    """Propose a map from what a displacement sensor saw of the guide on many strokes.

    Nothing takes the new map over by itself: look at its change, then name it in `stage.guide.file`. The sensor rides
    on the slider and measures against a straight edge; its topic `displacement` must have been recorded with the
    strokes. The encoders alone do not see the guide move.
    """
    from straightcomp_ros.fleet.history.store import Store
    from straightcomp_ros.fleet.maintenance.map_proposal import proposed_map
    from straightcomp_ros.straightness.guide_map import find_survey

    old = find_survey(options.survey)
    output, plot = output_file(options, "--output"), output_file(options, "--plot", PICTURES)
    if output is not None and os.path.realpath(output) == str(old):
        raise CommandFailed(f"--output {output}: is the present map; name another file", exit_code=2)
    guide = chosen_guide(options)
    proposal = proposed_map(Store(options.store).strokes(options.name), Path(old), options.days, guide)
    if output is not None:
        proposal.built.write(output)
    if plot is not None:
        from straightcomp_ros.analysis.map_page import plot_map

        plot_map(proposal.built, plot)
    if options.json:
        built = proposal.built
        change = {"x_mm": (built.straightness.report.x * 1e3).tolist(), "change_um": (proposal.change * 1e6).tolist()}
        print_json({**proposal.figures(), **change, "provenance": built.provenance, "output": options.output})
        return
    console.print(figures_table(f"Proposed map of stage '{options.name}'", proposal.figures()))
    if output is not None or plot is not None:
        print_written(*filter(None, (output, plot)), then="name the map in stage.guide.file; straightcomp stage check")


def _add_stages(parser: argparse.ArgumentParser) -> None:
    """Declare the store, ``--name`` and ``--since``."""
    add = parser.add_argument
    add("store", nargs="?", default=_STORE, metavar="STORE", help=_STORE_HELP)
    add_repeatable(parser, "--name", "NAME", "only the stage of this name")
    since = (
        "strokes from this day on, YYYY-MM-DD: that after the last maintenance, whose first four weeks are the measure"
    )
    add("--since", type=_day, metavar="DATE", help=since)


def _day(text: str) -> datetime:
    """The beginning of a day, UTC."""
    try:
        return datetime.combine(date.fromisoformat(text), datetime.min.time(), timezone.utc)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r}; allowed: a date as 2026-11-24") from error


def _stored_stages(options: argparse.Namespace) -> Iterator[tuple[str, pyarrow.Table]]:
    """Each chosen stage with its strokes. One without strokes is noted; CommandFailed if none has any."""
    import pyarrow.compute

    from straightcomp_ros.fleet.history.store import Store

    store = Store(options.store)
    found, since = False, f" since {options.since:%Y-%m-%d}" if options.since else ""
    for name in (names := options.name or store.stages()):
        strokes = store.strokes(name)
        if options.since is not None:
            strokes = strokes.filter(pyarrow.compute.greater_equal(strokes["start"], options.since))
        if strokes.num_rows:
            found = True
            yield name, strokes
        else:
            notes.print(f"stage '{name}' has no strokes{since}")
    if not found:
        if names:
            raise CommandFailed(f"store {options.store}: no strokes{since} of {', '.join(names)}")
        fill = "fill it by `straightcomp history add`"
        raise CommandFailed(f"store {options.store} has no strokes; {fill}", exit_code=2)


def _written(
    folder: Path, ending: str, stages: Iterable[str], texts: Iterable[tuple[str, str]], force: bool
) -> dict[str, Path]:
    """Write a text for each of these stages into a folder, and return its file: a stage may be called anything."""
    from straightcomp_ros.fleet.history.rows import stored_name
    from straightcomp_ros.parameters.output_files import making, write_whole

    files = {stage: folder / f"{quote(stored_name(stage), safe=' ')}{ending}" for stage in stages}
    with making(folder, [file.name for file in files.values()], force=force, anew=False):
        for stage, text in texts:
            write_whole(files[stage], text)
    return files


TOOLS = {
    "add": Tool("add the strokes of bags to a store", _add_arguments, _add),
    "query": Tool("ask a store in SQL", _query_arguments, _query),
    "advise": Tool("what changed on a stage, why, and what helps", _advise_arguments, _advise),
    "report": Tool("a page for each stage: trends, advice, error over x and time", _report_arguments, _report),
    "map": Tool("propose a map from the strokes of the last days", _map_arguments, _map),
}
