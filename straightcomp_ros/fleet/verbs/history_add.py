"""Add the figures of each stroke of each bag to a store.

A bag that the store has, unchanged, costs nothing, so the same command may run every hour, and after a kill or a
failure. Several processes may add to one store at once. Bags and stores may be URLs of any kind that fsspec knows, for
example s3://bucket/folder.

A bag that was cut off, is damaged or has no stroke is refused: the store's table `refused` says why. The exit code is 1
if a bag was refused now.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from itertools import chain
from typing import TYPE_CHECKING

from straightcomp_ros.cli.evaluate import add_remap_option, parsed_remap
from straightcomp_ros.cli.options import add_dask, check_range, whole_number
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, progress_bar

if TYPE_CHECKING:
    from straightcomp_ros.fleet.history.bag_places import BagPlace
    from straightcomp_ros.fleet.history.bag_row import BagRow

SUMMARY = "add the strokes of bags to a store"
DEFAULT_STORE = "history"
_LONGEST_WAIT = 86_400.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("bags", nargs="+", metavar="BAG", help="rosbag2 folder, MCAP or SQLite file, or a folder of bags")
    add("--store", "-o", default=DEFAULT_STORE, metavar="STORE", help="folder or URL (default: %(default)s)")
    add("--jobs", type=whole_number(1), metavar="N", help="processes on this machine (default: all cores)")
    add_dask(parser)
    add("--again", action="store_true", help="evaluate bags that the store has, too: after an update of this program")
    add("--follow", action="store_true", help="go on until Ctrl-C, adding each new bag when its recording has ended")
    wait = "with --follow: seconds between two looks (default: %(default)g)"
    add("--every", type=float, default=10.0, metavar="S", help=wait)
    add_remap_option(parser)
    add("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    from straightcomp_ros.fleet.history.adding import Tally, add
    from straightcomp_ros.fleet.history.bag_places import bags_in
    from straightcomp_ros.fleet.history.growing_folders import GrowingFolders
    from straightcomp_ros.fleet.history.store import Store

    check_range("--every", options.every, 0.1, _LONGEST_WAIT, "s")
    remap = parsed_remap(options.remap)
    store, tally, growing = Store(options.store), Tally(), GrowingFolders()
    for url in options.bags:
        if next(bags_in(url), None) is None and not options.follow:
            raise CommandFailed(f"{url}: no bag is there; allowed: a bag, or a folder with bags below it", exit_code=2)

    def look() -> Iterator[BagPlace]:
        found = chain.from_iterable(map(bags_in, options.bags))
        return growing.whole(found) if options.follow else found

    with progress_bar() as bar:
        task = bar.add_task("looking for bags", total=None)

        def told(row: BagRow) -> None:
            bar.update(task, description=f"{tally.added} bags with {tally.strokes} strokes")
            if row.reason is not None:
                notes.print(f"refused: {row.reason}", soft_wrap=True, highlight=False)
            if row.checksum is None:
                growing.retry(row)

        def add_new() -> None:
            workers = {"jobs": options.jobs or -1, "dask": options.dask}
            add(store, look(), tally, again=options.again, remap=remap, told=told, **workers)

        add_new()
        # Ctrl-C is the usual end of these.
        with suppress(KeyboardInterrupt):
            while options.follow:
                time.sleep(options.every)
                add_new()
    if options.json:
        print_json({"store": options.store, **asdict(tally)})
    else:
        counts = f"added {tally.added}, known and unchanged {tally.known}, refused {tally.refused}"
        console.print(f"{options.store}: bags {counts}; strokes added {tally.strokes}", soft_wrap=True)
    if tally.refused:
        remedy = f'straightcomp history query {options.store} "SELECT * FROM refused"'
        raise CommandFailed(f"bags refused: {tally.refused}; the reasons: {remedy}")
