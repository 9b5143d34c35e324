"""Run several stages, each alone and then all at once, and compare how accurately they move.

Each stage has its graph in a namespace of its own, all in one ROS domain, as several launches on one computer have."""

import argparse
import tempfile
from contextlib import ExitStack
from pathlib import Path

from straightcomp_ros.cli.law_tables import rounded, titled_table
from straightcomp_ros.cli.options import add_repeatable, check_range, output_folder
from straightcomp_ros.cli.output import CommandFailed, console, print_json, progress_bar, require_ros
from straightcomp_ros.configuration.parameter_file import DEFAULT_STAGE
from straightcomp_ros.settings.share import share_path

SUMMARY = "several stages on this computer, alone and at once"
_MOST = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_repeatable(parser, "--stage", "FILE", "description of a stage (default: the shipped one, twice)")
    parser.add_argument("--rounds", type=int, default=1, metavar="N", help="strokes of each (default: %(default)s)")
    parser.add_argument("--output", "-o", metavar="DIR", help="keep bags and logs here (default: they are removed)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Measure and print; exit code 1 if a run was not in order."""
    from straightcomp_ros.trials.bench.demo_strokes import BenchFailed
    from straightcomp_ros.trials.bench.several_stages import measure

    require_ros()
    check_range("--rounds", options.rounds, 1, 1000)
    stages = options.stage or [str(share_path(DEFAULT_STAGE))] * 2
    if not 2 <= len(stages) <= _MOST:
        raise CommandFailed(f"--stage: {len(stages)} stages; allowed: 2 to {_MOST}", exit_code=2)
    with ExitStack() as stack:
        folder = (
            output_folder("--output", options.output)
            if options.output
            else Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="straightcomp_bench_")))
        )
        bar = stack.enter_context(progress_bar())
        task = bar.add_task("starting", total=1.0)
        try:
            figures = measure(
                stages,
                options.rounds,
                folder,
                progress=lambda text, done: bar.update(task, description=text, completed=done),
            )
        except BenchFailed as error:
            raise CommandFailed(str(error)) from error
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
