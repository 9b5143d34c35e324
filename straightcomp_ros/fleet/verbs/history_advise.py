"""Say what changed on each stage of a store, since when, the likely cause and what helps.

Levels of days are compared with those of the first four weeks, so that a stage needs five weeks of strokes. After
maintenance give its day by --since. With -o a small JSON file for each stage is written, which the live view
(`straightcomp view --maintenance FILE`) and the OPC UA gateway (parameter `maintenance_file`, alarm MaintenanceDue)
show: run it once a day.
"""

from __future__ import annotations

import argparse
from typing import Any

from straightcomp_ros.cli.options import add_force, output_folder
from straightcomp_ros.cli.output import console, notes, print_json
from straightcomp_ros.fleet.verbs.stored_stages import add_stages, file_of, stored_stages

SUMMARY = "what changed on a stage, why, and what helps"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_stages(parser)
    parser.add_argument("--output", "-o", metavar="DIR", help="write STAGE.json for each stage into this folder")
    add_force(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    from straightcomp_ros.fleet.maintenance.advice import advice_of
    from straightcomp_ros.fleet.maintenance.advice_file import advice_json, write_advice
    from straightcomp_ros.fleet.maintenance.day_levels import COLUMNS, day_levels
    from straightcomp_ros.fleet.maintenance.level_change import BASELINE
    from straightcomp_ros.parameters.output_files import making

    folder = output_folder("--output", options.output) if options.output else None
    told: dict[str, Any] = {}
    for stage, strokes in stored_stages(options, COLUMNS):
        levels = day_levels(strokes)
        days = len(levels.day)
        advice = advice_of(levels)
        told[stage] = advice_json(stage, levels.date(-1), advice)
        if options.json:
            continue
        if days <= BASELINE:
            notes.print(f"{stage}: {days} days with strokes; allowed: > {BASELINE}, the baseline", soft_wrap=True)
            continue
        due = sum(one.due for one in advice)
        style = "yellow" if due else "green"
        matters = f"matters: {due}" if due else "nothing to do"
        console.print(f"{stage}, {days} days until {levels.date(-1)}: {matters}", style=style, highlight=False)
        for one in advice:
            console.print(f"  found {one.found}: {one.text}", soft_wrap=True, highlight=False)
            what = one.remedy if one.due else "nothing: it is back where it was"
            console.print(f"    → {what}", soft_wrap=True, highlight=False)
    if folder is not None:
        files = {file_of(stage, ".json"): content for stage, content in told.items()}
        with making(folder, files, force=options.force, anew=False):
            for name, content in files.items():
                write_advice(folder / name, content)
    if options.json:
        print_json({"stages": told})
