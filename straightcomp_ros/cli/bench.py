"""Measure this machine: the running graph, or the parts of it that are called in each cycle."""

from __future__ import annotations

import argparse
import importlib

SUMMARY = "measure the graph's timing, or what its parts cost"

_BENCHES = ("bags", "can", "graph", "step")
"""Each is a module ``bench_<name>`` beside this one, with SUMMARY, add_arguments and run, as a verb is."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benches."""
    benches = parser.add_subparsers(dest="bench", metavar="BENCH", required=True)
    for name in _BENCHES:
        module = importlib.import_module(f"straightcomp_ros.cli.bench_{name}")
        bench = benches.add_parser(
            name, help=module.SUMMARY, description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        module.add_arguments(bench)
        bench.set_defaults(run_bench=module.run)


def run(options: argparse.Namespace) -> int:
    """Run the bench that was named."""
    return int(options.run_bench(options))
