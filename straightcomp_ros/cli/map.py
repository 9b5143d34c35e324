"""Work on the map of the guide: take surveys over from instruments and controllers, hand the map on."""

from __future__ import annotations

import argparse

from straightcomp_ros.cli.tools import add_tools, run_tool

SUMMARY = "build the map of the guide from a survey, convert surveys, export a controller's error table"
run = run_tool


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the tools."""
    add_tools(parser, __name__, ("build", "convert", "export"))
