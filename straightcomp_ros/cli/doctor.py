"""Look at this machine: what would a run miss here, and what helps? With --stage, at its delay and frames too.

Each check is ok, warn (it runs, but less well, or not in every way) or fail. The exit code is 1 if one fails."""

import argparse
import itertools

from straightcomp_ros.cli.options import add_json
from straightcomp_ros.cli.results import show_findings
from straightcomp_ros.doctor.computer import examine

SUMMARY = "look at this machine and say what to do"
PURPOSE = "set up"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--stage", metavar="FILE", help="stage file: look at its delay and its board's frames too")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    found = examine()
    if options.stage:
        from straightcomp_ros.doctor.computer import timer
        from straightcomp_ros.doctor.stage_findings import board_findings
        from straightcomp_ros.parameters.node_parameters import node_parameters
        from straightcomp_ros.parameters.parameter_file import shipped_parameters

        driver = node_parameters("driver", shipped_parameters(stage=options.stage))
        found = itertools.chain(found, (timer(stage=one) for one in [driver.stage]), board_findings(driver))
    return show_findings(found, json=options.json)
