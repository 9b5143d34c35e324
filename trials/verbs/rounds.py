"""The options and the progress bar of benches that run rounds of strokes."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from straightcomp_ros.cli.options import check_range, results_folder
from straightcomp_ros.cli.output import CommandFailed, progress_bar
from trials.bench.demo_strokes import BenchFailed

_MOST_ROUNDS = 1000


def add_rounds(parser: argparse.ArgumentParser) -> None:
    """Declare ``--rounds``."""
    parser.add_argument("--rounds", type=int, default=1, metavar="N", help="strokes of each (default: %(default)s)")


@contextmanager
def rounds(options: argparse.Namespace) -> Iterator[tuple[Path, Callable[[str, float], None]]]:
    """The folder of the results, and what shows the stroke that begins now and the finished fraction.

    Raises:
        CommandFailed: ``--rounds`` is not allowed, or a stroke has failed.
    """
    check_range("--rounds", options.rounds, 1, _MOST_ROUNDS)
    with results_folder(options) as folder, progress_bar() as bar:
        task = bar.add_task("starting", total=1.0)
        try:
            yield folder, lambda text, done: bar.update(task, description=text, completed=done)
        except BenchFailed as error:
            raise CommandFailed(str(error)) from error
