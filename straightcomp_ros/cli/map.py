"""Work on the map of the guide: take surveys over from instruments and controllers, hand the map on."""

from __future__ import annotations

import argparse
import importlib

SUMMARY = "build the map of the guide from a survey, convert surveys, export a controller's error table"

_TOOLS = ("build", "convert", "export")
"""Each is a module ``map_<name>`` beside this one, with SUMMARY, add_arguments and run, as a verb is."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the tools."""
    tools = parser.add_subparsers(dest="tool", metavar="TOOL", required=True)
    for name in _TOOLS:
        module = importlib.import_module(f"straightcomp_ros.cli.map_{name}")
        tool = tools.add_parser(
            name, help=module.SUMMARY, description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        module.add_arguments(tool)
        tool.set_defaults(run_tool=module.run)


def run(options: argparse.Namespace) -> int:
    """Run the tool that was named."""
    return int(options.run_tool(options))
