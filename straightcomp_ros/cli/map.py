"""The map of the guide, from which the reference is made."""

from __future__ import annotations

import argparse
import importlib

SUMMARY = "make the map of the guide from a survey"

_ACTIONS = ("build",)
"""Each is a module ``map_<name>`` beside this one, with SUMMARY, add_arguments and run, as a verb is."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what can be done with maps."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    for name in _ACTIONS:
        module = importlib.import_module(f"straightcomp_ros.cli.map_{name}")
        action = actions.add_parser(
            name, help=module.SUMMARY, description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        module.add_arguments(action)
        action.set_defaults(run_action=module.run)


def run(options: argparse.Namespace) -> int:
    """Do what was named."""
    return int(options.run_action(options))
