"""Check the description of a stage as an engineer would read it: survey, travel, reference, stability, force, quanta.

Each finding is ok, warn (it works, but less well) or fail. The exit code is 1 if one fails."""

import argparse

from straightcomp_ros.cli.findings import show_findings
from straightcomp_ros.cli.parameter_options import checked_values
from straightcomp_ros.configuration.node_parameters import node_parameters
from straightcomp_ros.configuration.parameter_file import shipped_parameters
from straightcomp_ros.doctor.stage_findings import stage_findings

SUMMARY = "check a description: what does not fit together, why, and what helps"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="STAGE", help="stage file")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    values = checked_values(shipped_parameters(stage=options.file))
    controller = node_parameters("controller", values)
    tracking = node_parameters("feedforward", values).feedforward
    return show_findings(stage_findings(controller.stage, controller.control, tracking), json=options.json)
