"""The option that chooses a running graph as the machine, for the verbs that measure one."""

import argparse
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from straightcomp_ros.cli.options import add_namespace
from straightcomp_ros.cli.output import CommandFailed, require_ros

RUNNING, START, EMULATED = "running", "start", "start-emulated"


def add_graph_option(parser: argparse.ArgumentParser) -> None:
    """Add --graph and --namespace."""
    parser.add_argument(
        "--graph",
        choices=(START, EMULATED, RUNNING),
        help="the machine is that of a graph of nodes, in real time: start the nodes for this (start), or with an "
        "emulated board on a CAN bus between processes (start-emulated), or use those that run (running)",
    )
    add_namespace(parser)


def graph_access(
    options: argparse.Namespace, values: Mapping[str, Mapping[str, Any]], folder: Path
) -> AbstractContextManager[Any]:
    """The `Access` to the machine that --graph names.

    Nodes that are started get ``values``; ``folder`` gets bags and logs.

    Raises:
        CommandFailed: the options contradict each other, or ROS is not there.
    """
    if options.namespace and options.graph != RUNNING:
        raise CommandFailed(f"--namespace: allowed with --graph {RUNNING}", exit_code=2)
    require_ros()
    # Only here: they need ROS.
    from straightcomp_ros.runtime.machine_access import running_graph, started_graph

    if options.graph == RUNNING:
        return running_graph(folder, options.namespace)
    return started_graph(values, folder, emulated=options.graph == EMULATED)
