"""Look at this machine: what would a run miss here, and what helps?

Each check is ok, warn (it runs, but less well, or not in every way) or fail. The exit code is 1 if one fails."""

import argparse

from straightcomp_ros.cli.options import add_json
from straightcomp_ros.cli.results import show_findings
from straightcomp_ros.doctor.computer import examine

SUMMARY = "look at this machine and say what to do"
PURPOSE = "set up"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    return show_findings(examine(), json=options.json)
