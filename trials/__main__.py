"""The command of the rigs, in a checkout: python -m trials RIG [OPTIONS]. Each prints one JSON object."""

import sys

from straightcomp_ros.cli.main import main

RIGS = ("bags", "can", "faults", "history", "kills", "soak", "wear")

if __name__ == "__main__":
    sys.exit(main(verbs={name: f"trials.{name}" for name in RIGS}, program="python -m trials"))
