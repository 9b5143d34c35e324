"""The command of the rigs, in a checkout: python -m trials RIG [OPTIONS]. Each prints one JSON object."""

import sys
from collections.abc import Sequence

from straightcomp_ros.cli.main import main

RIGS = ("can", "faults", "motions", "noise", "power_cuts", "soak", "verdict", "wear")


def run(arguments: Sequence[str] | None = None) -> int:
    """Run a rig; returns its exit code."""
    return main(arguments, {name: f"trials.{name}" for name in RIGS}, "python -m trials")


if __name__ == "__main__":
    sys.exit(run())
