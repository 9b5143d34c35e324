"""Verbs that are families of tools: each tool is a module of its own, made as a verb is."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Sequence


def add_tools(parser: argparse.ArgumentParser, family: str, names: Sequence[str], metavar: str = "TOOL") -> None:
    """Declare the tools of a verb: for each name the module ``<family>_<name>`` with SUMMARY, add_arguments and run;
    ``family`` is the dotted name of the verb's own module."""
    tools = parser.add_subparsers(dest="tool", metavar=metavar, required=True)
    for name in names:
        module = importlib.import_module(f"{family}_{name}")
        tool = tools.add_parser(
            name, help=module.SUMMARY, description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        module.add_arguments(tool)
        tool.set_defaults(run_tool=module.run)


def run_tool(options: argparse.Namespace) -> int:
    """Run the tool that was named."""
    return int(options.run_tool(options))
