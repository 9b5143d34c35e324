"""What the rigs share: where their files go, and the bar that shows how far they are."""

import argparse
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from straightcomp_ros.cli.options import output_folder
from straightcomp_ros.cli.output import progress_bar

_Item = TypeVar("_Item")


def add_output(parser: argparse.ArgumentParser) -> None:
    """Declare ``--output``."""
    parser.add_argument("--output", "-o", metavar="DIR", help="keep bags and logs here (default: they are removed)")


@contextmanager
def output(options: argparse.Namespace) -> Iterator[Path]:
    """The empty folder that ``--output`` names, or one that is removed in the end."""
    if options.output:
        yield output_folder("--output", options.output, empty=True).absolute()
        return
    with tempfile.TemporaryDirectory(prefix="straightcomp_trial_") as folder:
        yield Path(folder)


def tracked(items: Iterable[_Item], text: str) -> Iterator[_Item]:
    """The items one by one, with a bar on the terminal."""
    with progress_bar() as bar:
        yield from bar.track(items, description=text)
