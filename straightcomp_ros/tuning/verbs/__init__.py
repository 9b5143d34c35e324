"""The verbs of the wing; and the option that chooses a running graph as the machine, for those that measure one."""

import argparse
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from straightcomp_ros.cell.stop_signals import terminating
from straightcomp_ros.cli.options import add_namespace, attribute
from straightcomp_ros.cli.output import CommandFailed, Terminated, require_ros

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


def refuse_parameters_of_running(options: argparse.Namespace, *names: str) -> None:
    """Raise CommandFailed with exit code 2 if one of these options, which choose parameters, is given with --graph
    running."""
    given = [name for name in names if getattr(options, attribute(name))]
    if options.graph == RUNNING and given:
        raise CommandFailed(f"{given[0]}: not with --graph {RUNNING}, whose nodes have parameters", exit_code=2)


@contextmanager
def graph_access(options: argparse.Namespace, values: Mapping[str, Mapping[str, Any]], folder: Path) -> Iterator[Any]:
    """The `Access` to the machine that --graph names.

    Nodes that are started get ``values``; ``folder`` gets bags and logs. SIGTERM and SIGHUP release the machine like
    SIGINT.

    Raises:
        CommandFailed: the options contradict each other, or ROS is not there.
    """
    if options.namespace and options.graph != RUNNING:
        raise CommandFailed(f"--namespace: allowed with --graph {RUNNING}", exit_code=2)
    require_ros()
    # Only here: they need ROS.
    from straightcomp_ros.tuning.graph.running_machine import running_graph, started_graph

    if options.graph == RUNNING:
        access = running_graph(folder, options.namespace)
    else:
        access = started_graph(values, folder, emulated=options.graph == EMULATED)
    before = {number: signal.signal(number, _terminate) for number in terminating()}
    try:
        with access as machine:
            yield machine
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _terminate(*_: object) -> None:
    # A second one must not interrupt what the first has begun: to release the machine.
    for number in terminating():
        signal.signal(number, signal.SIG_IGN)
    raise Terminated
