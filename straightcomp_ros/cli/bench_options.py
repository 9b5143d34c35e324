"""What benches with bags and logs have in common: options, the folder of the results, the bar for rounds of strokes."""

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from straightcomp_ros.cli.options import output_folder


def add_json(parser: argparse.ArgumentParser) -> None:
    """Declare ``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def add_results(parser: argparse.ArgumentParser) -> None:
    """Declare ``--output`` and ``--json``."""
    parser.add_argument("--output", "-o", metavar="DIR", help="keep bags and logs here (default: they are removed)")
    add_json(parser)


@contextmanager
def results_folder(options: argparse.Namespace) -> Iterator[Path]:
    """The folder that ``--output`` names, or one that is removed in the end."""
    if options.output:
        yield output_folder("--output", options.output, empty=True).absolute()
        return
    with tempfile.TemporaryDirectory(prefix="straightcomp_bench_") as folder:
        yield Path(folder)
