"""Generate many bags of ten stages and add them to a store: bags a second, memory, the same with two Dask workers,
again, and beside rosbags with pandas. A bag is a simulated cycle of 50 mm there and back, 2.2 s, and takes about 1 MB
of the disk with the folder for temporary files (TMPDIR)."""

import argparse

from straightcomp_ros.cli.options import check_range
from straightcomp_ros.cli.output import console, print_json, progress_bar
from straightcomp_ros.cli.results import figures_table

SUMMARY = "adding bags to a history: speed, memory, Dask"
_MOST_BAGS = 1_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--bags", type=int, default=2000, metavar="N", help="number of bags (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Measure and print."""
    from trials.bench.bag_costs import flattened
    from trials.bench.history_bench import run

    check_range("--bags", options.bags, 1, _MOST_BAGS)
    with progress_bar() as bar:
        task = bar.add_task("starting", total=1.0)
        figures = run(options.bags, lambda text, done: bar.update(task, description=text, completed=done))
    if options.json:
        print_json(figures)
        return 0
    console.print(figures_table("History", flattened(figures)))
    return 0
