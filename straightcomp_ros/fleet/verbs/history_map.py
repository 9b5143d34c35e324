"""Propose a map from what a displacement sensor saw of the guide on many strokes.

Nothing takes the new map over by itself: look at its change, then name it in `stage.guide.file`. The sensor rides on
the slider and measures against a straight edge; its topic `displacement` must have been recorded with the strokes. The
encoders alone do not see the guide move.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from straightcomp_ros.cli.options import PICTURES, add_force, check_range, output_file
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json
from straightcomp_ros.cli.results import figures_table

SUMMARY = "propose a map from the strokes of the last days"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("store", metavar="STORE", help="folder or URL")
    add("stage", metavar="STAGE", help="name of the stage")
    add("--map", required=True, metavar="FILE", help="the survey that the strokes used")
    add("--output", "-o", metavar="FILE", help="write the proposed map (CSV); without it nothing is written")
    add_force(parser)
    add("--days", type=float, default=7.0, metavar="N", help="before the last stroke (default: %(default)g)")
    add("--plot", metavar="FILE", help="also save a plot (PNG, SVG or PDF)")
    add("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    from straightcomp_ros.fleet.history.store import Store
    from straightcomp_ros.fleet.maintenance.map_proposal import COLUMNS, proposed_map
    from straightcomp_ros.straightness.guide_map import find_survey

    check_range("--days", options.days, 0.01, 3650.0, "days")
    old = find_survey(options.map)
    output, plot = output_file(options, "--output"), output_file(options, "--plot", PICTURES)
    if output is not None and output.resolve() == old:
        raise CommandFailed(f"--output {output}: is the present map; name another file", exit_code=2)
    proposal = proposed_map(Store(options.store).strokes(options.stage, COLUMNS), Path(old), options.days)
    if output is not None:
        proposal.built.write(output)
    if plot is not None:
        from straightcomp_ros.analysis.pictures import plot_map

        plot_map(proposal.built, plot)
    if options.json:
        x = (proposal.built.repeatability.x * 1e3).tolist()
        change = {"x_mm": x, "change_um": (proposal.change * 1e6).tolist()}
        provenance = dict(proposal.built.provenance)
        print_json({**proposal.figures(), **change, "provenance": provenance, "output": options.output})
        return
    console.print(figures_table(f"Proposed map of stage '{options.stage}'", proposal.figures()))
    if output is not None:
        notes.print(f"map: {output}; to use it, name it in stage.guide.file", soft_wrap=True)
