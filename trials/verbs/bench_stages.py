"""Run several stages, each alone and then all at once, and compare how accurately they move.

Each stage has its graph in a namespace of its own, all in one ROS domain, as several launches on one computer have."""

import argparse

from straightcomp_ros.cli.options import add_repeatable, add_results
from straightcomp_ros.cli.output import CommandFailed, console, print_json, require_ros
from straightcomp_ros.cli.results import rounded, titled_table
from straightcomp_ros.parameters.parameter_file import DEFAULT_STAGE
from straightcomp_ros.parameters.share import share_path
from trials.verbs.rounds import add_rounds, rounds

SUMMARY = "several stages on this computer, alone and at once"
_MOST = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_repeatable(parser, "--stage", "FILE", "description of a stage (default: the shipped one, twice)")
    add_rounds(parser)
    add_results(parser)


def run(options: argparse.Namespace) -> int:
    """Measure and print; exit code 1 if a run was not in order."""
    from trials.bench.several_stages import measure

    require_ros()
    stages = options.stage or [str(share_path(DEFAULT_STAGE))] * 2
    if not 2 <= len(stages) <= _MOST:
        raise CommandFailed(f"--stage: {len(stages)} stages; allowed: 2 to {_MOST}", exit_code=2)
    with rounds(options) as (folder, progress):
        figures = measure(stages, options.rounds, folder, progress)
    if options.json:
        print_json(figures)
    else:
        table = titled_table("Stages at once", "stage", "alone [µm]", "at once [µm]", "ratio", "lost", "verdict")
        for name, figure in figures["stages"].items():
            alone, at_once = (rounded(figure[when]["pp_um"], 3) for when in ("alone", "at_once"))
            lost = str(figure["at_once"]["lost_samples"])
            table.add_row(name, alone, at_once, f"{figure['ratio']:.2f}", lost, figure["at_once"]["verdict"])
        console.print(table)
    return 0 if figures["in_order"] else 1
