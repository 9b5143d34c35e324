"""Write a report of each stage of a store: one HTML file that needs no network.

Advice with its evidence, trends of all figures, the error over x and time, faults, and the bags to look at.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from straightcomp_ros.cli.options import add_force, output_folder
from straightcomp_ros.cli.output import console, print_json
from straightcomp_ros.fleet.verbs.stored_stages import add_stages, file_of, stored_stages

SUMMARY = "a page for each stage: trends, advice, error over x and time"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_stages(parser)
    parser.add_argument("--output", "-o", metavar="DIR", default="report", help="folder (default: %(default)s)")
    add_force(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    from straightcomp_ros.fleet.maintenance.stage_report import COLUMNS, stage_report
    from straightcomp_ros.parameters.output_files import making, write_whole

    folder = output_folder("--output", options.output)
    pages = {stage: stage_report(stage, strokes) for stage, strokes in stored_stages(options, COLUMNS)}
    files = {stage: str(folder / file_of(stage, ".html")) for stage in pages}
    with making(folder, [Path(path).name for path in files.values()], force=options.force, anew=False):
        for stage, path in files.items():
            write_whole(path, pages[stage])
            if not options.json:
                console.print(f"{stage}: {path}", soft_wrap=True, highlight=False)
    if options.json:
        print_json({"reports": files})
