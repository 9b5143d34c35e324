"""Make one file of the strokes of each stage and month, so that queries over years are fast.

A store has a file for each bag, and opening them takes longer than reading them. Nothing is lost or doubled whenever
this is killed, other processes may add at the same time, and known bags stay known: run it once a month, or once a day.
"""

from __future__ import annotations

import argparse

from straightcomp_ros.cli.output import console, print_json, progress_bar
from straightcomp_ros.fleet.verbs.history_add import DEFAULT_STORE

SUMMARY = "one file for each stage and month, for fast queries"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("store", nargs="?", default=DEFAULT_STORE, metavar="STORE", help="folder (default: %(default)s)")
    add("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    from straightcomp_ros.fleet.history.store import Store

    store, months, files = Store(options.store), 0, 0
    with progress_bar() as bar:
        task = bar.add_task("looking for months", total=None)
        for month, merged in store.compact():
            bar.update(task, description=month)
            months, files = months + bool(merged), files + merged
    if options.json:
        print_json({"store": options.store, "months": months, "files": files})
    else:
        console.print(f"{options.store}: {files} files of {months} months became {months}", soft_wrap=True)
