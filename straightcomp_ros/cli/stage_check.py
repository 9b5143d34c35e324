"""Check the description of a stage as an engineer would read it: survey, travel, reference, stability, force, quanta,
and the DBC file of a board on CAN.

Each finding is ok, warn (it works, but less well) or fail. The exit code is 1 if one fails."""

import argparse
import itertools

from straightcomp_ros.cli.findings import show_findings
from straightcomp_ros.cli.parameter_options import add_stage_argument, stage_values
from straightcomp_ros.doctor.stage_findings import board_findings, stage_findings
from straightcomp_ros.parameters.node_parameters import node_parameters

SUMMARY = "check a description: what does not fit together, why, and what helps"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_stage_argument(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    values = stage_values(options)
    controller = node_parameters("controller", values)
    tracking = node_parameters("feedforward", values).feedforward
    driver = node_parameters("driver", values)
    found = stage_findings(controller.stage, controller.control, tracking)
    return show_findings(itertools.chain(found, board_findings(driver)), json=options.json)
