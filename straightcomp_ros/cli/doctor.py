"""Look at this machine: what would a run miss here, and what helps?

Each check is ok, warn (it runs, but less well, or not in every way) or fail. The exit code is 1 if one fails."""

import argparse

from straightcomp_ros.cli.findings import show_findings
from straightcomp_ros.doctor.examination import examine

SUMMARY = "look at this machine and say what to do"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    return show_findings(examine(), json=options.json)
