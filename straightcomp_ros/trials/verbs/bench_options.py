"""What benches with bags and logs have in common: options, the folder of the results, the bar for rounds of strokes."""

import argparse
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from straightcomp_ros.cli.options import check_range, output_folder
from straightcomp_ros.cli.output import CommandFailed, progress_bar
from straightcomp_ros.trials.bench.demo_strokes import BenchFailed

_MOST_ROUNDS = 1000


def add_json(parser: argparse.ArgumentParser) -> None:
    """Declare ``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def add_results(parser: argparse.ArgumentParser) -> None:
    """Declare ``--output`` and ``--json``."""
    parser.add_argument("--output", "-o", metavar="DIR", help="keep bags and logs here (default: they are removed)")
    add_json(parser)


def add_rounds(parser: argparse.ArgumentParser) -> None:
    """Declare ``--rounds``."""
    parser.add_argument("--rounds", type=int, default=1, metavar="N", help="strokes of each (default: %(default)s)")


@contextmanager
def results_folder(options: argparse.Namespace) -> Iterator[Path]:
    """The folder that ``--output`` names, or one that is removed in the end."""
    if options.output:
        yield output_folder("--output", options.output, empty=True).absolute()
        return
    with tempfile.TemporaryDirectory(prefix="straightcomp_bench_") as folder:
        yield Path(folder)


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
