"""What the rigs share: where their files go, the bar that shows how far they are, and a simulated run."""

import argparse
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.cli.options import output_folder
from straightcomp_ros.cli.output import progress_bar
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import Values, by_node

Progress = Callable[[str, float], object]
"""Called with what begins now and the finished fraction."""


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


@contextmanager
def progress() -> Iterator[Progress]:
    """A bar on the terminal."""
    with progress_bar() as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda text, done: bar.update(task, description=text, completed=done)


def simulated(bag: Path, values: Values) -> Path:
    """Record a simulated cycle of the stage to the new folder ``bag``."""
    simulation = Simulation(values)
    with SimulatedRun(bag, by_node(values), simulation.delay) as recording:
        simulation.run(observe=recording.add)
    return bag
