"""Options that choose parameters, the same for every verb that runs a servo."""

from __future__ import annotations

import argparse
from contextlib import suppress
from typing import Any

import yaml

from straightcomp_ros.cli.output import CommandFailed
from straightcomp_ros.configuration.node_parameters import NODE_PARAMETERS, node_parameters
from straightcomp_ros.configuration.parameter_file import read_parameter_file
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.settings.declaration import ParameterError
from straightcomp_ros.settings.share import share_path

DEFAULT_FILE = "config/straightcomp.yaml"


def add_parameter_options(parser: argparse.ArgumentParser) -> None:
    """Add --law, --params-file and --set."""
    parser.add_argument("--law", choices=LAWS, help="control law (default: the parameter file's)")
    parser.add_argument(
        "--params-file", metavar="FILE", help=f"ROS 2 parameter file (default: the installed {DEFAULT_FILE})"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NODE.NAME=VALUE",
        help="set one parameter, e.g. driver.simulated.plant.mass=3.5; may be repeated",
    )


def chosen_parameters(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Values by node and dotted name, checked.

    Raises:
        CommandFailed: a file, name or value is refused; exit code 2.
    """
    try:
        values = read_parameter_file(options.params_file or share_path(DEFAULT_FILE))
        for assignment in options.set:
            node, name, value = parsed_assignment(assignment)
            values[node][name] = value
        if options.law:
            values["controller"]["control.law"] = options.law
        for node in values:
            node_parameters(node, values[node])
    except (ParameterError, FileNotFoundError) as error:
        raise CommandFailed(str(error), exit_code=2) from error
    return values


def parsed_assignment(assignment: str) -> tuple[str, str, Any]:
    """Node, dotted name and value of NODE.NAME=VALUE; raises ParameterError."""
    target, equals, text = assignment.partition("=")
    node, dot, name = target.partition(".")
    if not (equals and dot) or node not in NODE_PARAMETERS:
        raise ParameterError(
            f"--set {assignment!r}: allowed: NODE.NAME=VALUE with NODE one of {', '.join(NODE_PARAMETERS)}"
        )
    # YAML 1.1 reads 1e6 as a text; a parameter file has the same trap, but here it can be helped.
    if "e" in text.lower():
        with suppress(ValueError):
            return node, name, float(text)
    try:
        return node, name, yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ParameterError(f"--set {assignment!r}: {text!r} is no YAML; put a text in quotes") from error
