"""Options that choose parameters, the same for every verb that runs a servo."""

import argparse
from typing import Any

from straightcomp_ros.cli.options import add_repeatable

Values = dict[str, dict[str, Any]]
"""Values of parameters by node and dotted name."""


def add_parameter_options(parser: argparse.ArgumentParser) -> None:
    """Add --stage, --law, --params-file and --set."""
    # Only here: what these import takes longer than most verbs' help.
    from straightcomp_ros.control.laws import LAWS
    from straightcomp_ros.parameters.parameter_file import DEFAULT_FILE, DEFAULT_STAGE

    add = parser.add_argument
    add("--stage", metavar="FILE", help=f"description of the stage (default: the installed {DEFAULT_STAGE})")
    add("--law", choices=LAWS, help="control law (default: the parameter file's)")
    add("--params-file", metavar="FILE", help=f"ROS 2 parameter file (default: the installed {DEFAULT_FILE})")
    add_setting_option(parser)


def add_setting_option(parser: argparse.ArgumentParser) -> None:
    """Add --set."""
    add_repeatable(parser, "--set", "NODE.NAME=VALUE", "set one parameter, e.g. stage.platform.mass=3.5")


def add_stage_argument(parser: argparse.ArgumentParser) -> None:
    """Add the stage file as an argument of its own."""
    parser.add_argument("file", metavar="STAGE", help="stage file")


def chosen_parameters(options: argparse.Namespace) -> Values:
    """Values by node and dotted name, checked; raises ParameterError."""
    return _changed(options.params_file, options.stage, chosen_changes(options))


def stage_values(options: argparse.Namespace) -> Values:
    """The same with the stage file of :func:`add_stage_argument`, and --set where the verb has it."""
    return _changed(None, options.file, _settings(getattr(options, "set", [])))


def chosen_changes(options: argparse.Namespace) -> Values:
    """What --set and --law change, by node and dotted name; raises ParameterError."""
    changes = _settings(options.set)
    if options.law:
        changes.setdefault("controller", {})["control.law"] = options.law
    return changes


def _changed(params_file: str | None, stage: str | None, changes: Values) -> Values:
    from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, node_parameters
    from straightcomp_ros.parameters.parameter_file import shipped_parameters

    values = shipped_parameters(params_file, stage)
    for node, section in changes.items():
        values[node].update(section)
    for node in NODE_PARAMETERS:
        node_parameters(node, values)
    return values


def _settings(assignments: list[str]) -> Values:
    from straightcomp_ros.parameters.declaration import ParameterError
    from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, STAGE
    from straightcomp_ros.parameters.yaml_text import YamlError, load_yaml

    changes: Values = {}
    for assignment in assignments:
        target, equals, text = assignment.partition("=")
        node, dot, name = target.partition(".")
        if not (equals and dot) or node not in (STAGE, *NODE_PARAMETERS):
            known = ", ".join((STAGE, *NODE_PARAMETERS))
            raise ParameterError(f"--set {assignment!r}: allowed: NODE.NAME=VALUE with NODE one of {known}")
        try:
            changes.setdefault(node, {})[name] = load_yaml(text)
        except YamlError as error:
            raise ParameterError(f"--set {assignment!r}: {text!r} is no YAML; put a text in quotes") from error
    return changes
