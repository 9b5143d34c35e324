"""Write a report of each stage of a store: one HTML file that needs no network.

Advice with its evidence, trends of all figures, the error over x and time, faults, and the bags to look at.
"""

from __future__ import annotations

import argparse

from straightcomp_ros.cli.options import output_folder
from straightcomp_ros.cli.output import console, print_json
from straightcomp_ros.cli.stored_stages import add_stages, file_of, stored_stages

SUMMARY = "a page for each stage: trends, advice, error over x and time"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_stages(parser)
    parser.add_argument("--output", "-o", metavar="DIR", default="report", help="folder (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    from straightcomp_ros.maintenance.stage_report import COLUMNS, stage_report
    from straightcomp_ros.settings.whole_file import write_whole

    folder = output_folder("--output", options.output)
    files = {}
    for stage, strokes in stored_stages(options, COLUMNS):
        path = folder / file_of(stage, ".html")
        write_whole(path, stage_report(stage, strokes))
        files[stage] = str(path)
        if not options.json:
            console.print(f"{stage}: {path}", soft_wrap=True, highlight=False)
    if options.json:
        print_json({"reports": files})
