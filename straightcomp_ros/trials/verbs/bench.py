"""Measure this machine: the running graph, or the parts of it that are called in each cycle."""

from __future__ import annotations

import argparse

from straightcomp_ros.cli.tools import add_tools, run_tool

SUMMARY = "measure the graph's timing, or what its parts cost"
run = run_tool


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benches."""
    add_tools(parser, __name__, ("bags", "can", "graph", "step"), metavar="BENCH")
