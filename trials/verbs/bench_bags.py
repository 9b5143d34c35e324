"""Measure the cost of recording, reading and evaluating bags, the loss by a SIGKILL, and whether an audit reproduces
every command."""

import argparse
from pathlib import Path

from straightcomp_ros.cli.options import check_range
from straightcomp_ros.cli.output import console, print_json, progress_bar
from straightcomp_ros.cli.results import figures_table

SUMMARY = "recording, reading, evaluation, SIGKILL, audit"
_MOST_KILL_RUNS = 10_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--bag", metavar="BAG", help="a recorded stroke (default: a full stroke is simulated)")
    parser.add_argument(
        "--kill-runs", type=int, default=20, metavar="N", help="recordings to kill (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Measure and print."""
    from trials.bench.bag_costs import flattened, run

    check_range("--kill-runs", options.kill_runs, 0, _MOST_KILL_RUNS)
    with progress_bar() as bar:
        task = bar.add_task("starting", total=1.0)
        figures = run(
            Path(options.bag) if options.bag else None,
            options.kill_runs,
            progress=lambda text, done: bar.update(task, description=text, completed=done),
        )
    if options.json:
        print_json(figures)
        return 0
    console.print(figures_table("Bags", flattened(figures)))
    return 0
