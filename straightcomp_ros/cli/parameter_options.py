"""Options that choose parameters, the same for every verb that runs a servo."""

import argparse
from collections.abc import Sequence
from typing import Any

from straightcomp_ros.cli.options import add_repeatable
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, STAGE, node_parameters
from straightcomp_ros.parameters.parameter_file import DEFAULT_FILE, DEFAULT_STAGE, shipped_parameters
from straightcomp_ros.parameters.yaml_text import YamlError, load_yaml


def add_parameter_options(parser: argparse.ArgumentParser) -> None:
    """Add --stage, --law, --params-file and --set."""
    add = parser.add_argument
    add("--stage", metavar="FILE", help=f"description of the stage (default: the installed {DEFAULT_STAGE})")
    add("--law", choices=LAWS, help="control law (default: the parameter file's)")
    add("--params-file", metavar="FILE", help=f"ROS 2 parameter file (default: the installed {DEFAULT_FILE})")
    add_setting_option(parser)


def add_setting_option(parser: argparse.ArgumentParser) -> None:
    """Add --set."""
    add_repeatable(parser, "--set", "NODE.NAME=VALUE", "set one parameter, e.g. stage.platform.mass=3.5")


def chosen_parameters(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Values by node and dotted name, checked; raises ParameterError."""
    values = shipped_parameters(options.params_file, options.stage)
    return _checked(_changed(values, chosen_changes(options)))


def add_stage_argument(parser: argparse.ArgumentParser) -> None:
    """Add the stage file as an argument of its own."""
    parser.add_argument("file", metavar="STAGE", help="stage file")


def stage_values(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Values by node and dotted name with the stage file of :func:`add_stage_argument`; raises ParameterError.

    --set counts too, where the verb has it.
    """
    return _checked(_changed(shipped_parameters(stage=options.file), _settings(getattr(options, "set", []))))


def _changed(values: dict[str, dict[str, Any]], changes: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    for node, section in changes.items():
        values[node].update(section)
    return values


def _checked(values: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    for node in NODE_PARAMETERS:
        node_parameters(node, values)
    return values


def chosen_changes(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """What --set and --law change, by node and dotted name; raises ParameterError."""
    changes = _settings(options.set)
    if options.law:
        changes.setdefault("controller", {})["control.law"] = options.law
    return changes


def _settings(assignments: Sequence[str]) -> dict[str, dict[str, Any]]:
    changes: dict[str, dict[str, Any]] = {}
    for assignment in assignments:
        node, name, value = _parsed_assignment(assignment)
        changes.setdefault(node, {})[name] = value
    return changes


def _parsed_assignment(assignment: str) -> tuple[str, str, Any]:
    target, equals, text = assignment.partition("=")
    node, dot, name = target.partition(".")
    if not (equals and dot) or node not in (STAGE, *NODE_PARAMETERS):
        known = ", ".join((STAGE, *NODE_PARAMETERS))
        raise ParameterError(f"--set {assignment!r}: allowed: NODE.NAME=VALUE with NODE one of {known}")
    try:
        return node, name, load_yaml(text)
    except YamlError as error:
        raise ParameterError(f"--set {assignment!r}: {text!r} is no YAML; put a text in quotes") from error
