"""Tools for the CAN bus."""

from __future__ import annotations

import argparse

from straightcomp_ros.cli.tools import add_tools, run_tool

SUMMARY = "a CAN bus between processes, and recorded buses"
run = run_tool


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the tools."""
    add_tools(parser, __name__, ("hub", "replay"))
