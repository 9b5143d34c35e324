"""Compute every figure of the paper anew, write each as a PNG, and put the paper's numbers beside ours.

A number that does not agree is no failure of the command: it is said so, and why, in the note."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.table import Table

from straightcomp_ros.cli.output import CommandFailed, console, notes, output_folder, print_json, progress_bar
from straightcomp_ros.cli.parameter_options import DEFAULT_FILE
from straightcomp_ros.configuration.parameter_file import read_parameter_file
from straightcomp_ros.paper.all_figures import Reproduction, reproduce
from straightcomp_ros.paper.claims import Claim
from straightcomp_ros.paper.ideal_machine import machine_from
from straightcomp_ros.settings.declaration import ParameterError
from straightcomp_ros.settings.share import share_path
from straightcomp_ros.straightness.survey import SurveyError

SUMMARY = "compute the paper's figures, and its numbers beside ours"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--output", "-o", metavar="DIR", default="reproduce_output", help="folder for the PNGs (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Reproduce with the shipped parameters and print the claims."""
    output = output_folder("--output", options.output)
    try:
        machine = machine_from(read_parameter_file(share_path(DEFAULT_FILE)))
        with progress_bar() as bar:
            task = bar.add_task("computing the figures", total=1.0)
            result = reproduce(machine, output, lambda fraction: bar.update(task, completed=fraction))
    except (ParameterError, SurveyError, FileNotFoundError) as error:
        raise CommandFailed(str(error), exit_code=2) from error
    if options.json:
        print_json(
            {
                "claims": [claim.to_display() for claim in result.claims],
                "figures": [str(path) for path in result.figures],
            }
        )
    else:
        _print(result, output)
    return 0


def _print(result: Reproduction, folder: Path) -> None:
    console.print(_table(result.claims))
    for claim in result.claims:
        if claim.within is False:
            console.print(f"not within tolerance: {claim.name}: {claim.note}", highlight=False)
    notes.print(f"{len(result.figures)} figures in {folder}", highlight=False)


def _table(claims: tuple[Claim, ...]) -> Table:
    table = Table(title="The paper's numbers and ours", title_justify="left")
    table.add_column("claim")
    table.add_column("paper", justify="right")
    table.add_column("ours", justify="right")
    table.add_column("unit")
    table.add_column("within")
    for claim in claims:
        paper = "" if claim.paper is None else f"{claim.paper:.4g}"
        within = {True: "yes", False: "no", None: ""}[claim.within]
        table.add_row(claim.name, paper, claim.shown, claim.unit, within)
    return table
