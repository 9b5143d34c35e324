"""The command of the trials: python -m trials, in a checkout."""

import sys

from straightcomp_ros.cli.main import main

VERBS = {"bench": "trials.verbs.bench", "faults": "trials.verbs.inject_faults", "soak": "trials.verbs.soak"}

if __name__ == "__main__":
    sys.exit(main(verbs=VERBS, program="python -m trials"))
