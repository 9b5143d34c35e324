"""Serve a page on this machine with live plots of the running graph, its state and faults, and buttons.

Open the address that is printed in a browser; the part behind the # is the token that the buttons need. The view is a
process of its own and only watches. Where the graph's nodes run with real-time priority, give --priority the same."""

from __future__ import annotations

import argparse

from straightcomp_ros.cli.output import CommandFailed
from straightcomp_ros.configuration import RealtimeParameters
from straightcomp_ros.launcher import ros_available
from straightcomp_ros.parameters import ParameterError, from_mapping

SUMMARY = "live plots of the running graph in a browser"
DEFAULT_PORT = 8765


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--port", type=int, default=DEFAULT_PORT, help="port on 127.0.0.1; 0 takes a free one (default: %(default)s)"
    )
    parser.add_argument("--namespace", default="", metavar="NAME", help="namespace of the graph")
    parser.add_argument(
        "--priority",
        type=int,
        default=0,
        metavar="N",
        help="SCHED_FIFO priority, that of the graph's nodes (default: 0)",
    )


def run(options: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM."""
    if not ros_available():
        raise CommandFailed("rclpy is not there; source a ROS 2 Jazzy installation", exit_code=2)
    if not 0 <= options.port <= 65535:
        raise CommandFailed(f"--port {options.port}: allowed: 0 to 65535", exit_code=2)
    try:
        realtime = from_mapping(RealtimeParameters, {"priority": options.priority})
    except ParameterError as error:
        raise CommandFailed(str(error), exit_code=2) from error
    from straightcomp_ros.nodes.view_node import view

    arguments = ["--ros-args", "-r", f"__ns:=/{options.namespace.strip('/')}"] if options.namespace else []
    return view(options.port, lambda url: print(url, flush=True), realtime, arguments)
