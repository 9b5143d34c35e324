"""Compute every figure of the paper anew, write each as a PNG, and compare the paper's numbers with ours.

A number that does not agree is no failure of the command: the note of that number says why."""

import argparse
from collections.abc import Callable, Mapping

from straightcomp_ros.analysis.pictures import save_whole
from straightcomp_ros.cli.options import add_force, add_json, output_folder
from straightcomp_ros.cli.output import console, print_json, print_written, working
from straightcomp_ros.cli.results import shown, titled_table
from straightcomp_ros.parameters.output_files import making
from straightcomp_ros.tuning.paper.figure import PaperFigure
from straightcomp_ros.tuning.paper.friction import friction_curve, stick_slip
from straightcomp_ros.tuning.paper.gain_error import far_release, gain_error
from straightcomp_ros.tuning.paper.machine import Machine, paper_machine
from straightcomp_ros.tuning.paper.recovery import recovery
from straightcomp_ros.tuning.paper.stroke import linear_stroke, sliding_mode_stroke, surveyed_guide
from straightcomp_ros.tuning.paper.surface import near_release, pole_claims

SUMMARY = "compute the paper's figures, and compare its numbers with ours"
PURPOSE = "tune"
FIGURES: Mapping[str, Callable[[Machine], PaperFigure]] = {
    "figure_2.png": surveyed_guide,
    "figure_3.png": gain_error,
    "figure_4.png": far_release,
    "beyond_figure_4.png": recovery,
    "figure_5.png": near_release,
    "figure_6.png": stick_slip,
    "figure_7.png": friction_curve,
    "figure_8.png": linear_stroke,
    "figure_9.png": sliding_mode_stroke,
}
"""By the name of its picture, what computes a figure."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--output", "-o", metavar="DIR", default="reproduce_output", help="folder for the PNGs (default: %(default)s)")
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Reproduce with the shipped parameters, but the paper's delay, and print the claims."""
    output = output_folder("--output", options.output)
    machine = paper_machine()
    claims = list(pole_claims(machine))
    with making(output, FIGURES, force=options.force) as place, working("computing the figures") as advance:
        for number, (name, compute) in enumerate(FIGURES.items()):
            advance(number / len(FIGURES))
            figure = compute(machine)
            save_whole(figure.picture, place / name)
            claims += figure.claims
        advance(1.0)
    if options.json:
        figures = [str(output / name) for name in FIGURES]
        print_json({"claims": [claim.to_display() for claim in claims], "figures": figures})
        return
    headings = ("claim", "paper", "ours", "unit", "within")
    table = titled_table("The paper's numbers and ours", *headings, left=("unit", "within"))
    for claim in claims:
        within = {True: "yes", False: "no", None: ""}[claim.within]
        table.add_row(claim.name, shown(claim.paper), claim.shown, claim.unit, within)
    console.print(table)
    for claim in claims:
        if claim.within is False:
            console.print(f"not within tolerance: {claim.name}: {claim.note}")
    print_written(
        *(output / name for name in FIGURES), then="compare them with the paper; docs/paper.md says what differs"
    )
