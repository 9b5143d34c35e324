"""Serve a page on this machine with live plots of the running graph, its state and faults, and buttons.

Open the address that is printed in a browser; the part behind the # is the token that the buttons need. The view is a
process of its own and only watches. Where the graph's nodes run with real-time priority, give --priority the same."""

import argparse
import re
import sys

from straightcomp_ros.cli.options import check_range
from straightcomp_ros.cli.output import CommandFailed, print_json, require_ros
from straightcomp_ros.settings.declaration import from_mapping
from straightcomp_ros.timing.realtime import RealtimeParameters

SUMMARY = "live plots of the running graph in a browser"
DEFAULT_PORT = 8765
_NAMESPACE = r"(/?[A-Za-z_]\w*)*/?"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--port", type=int, default=DEFAULT_PORT, help="port on 127.0.0.1; 0 takes a free one (default: %(default)s)")
    add("--namespace", default="", metavar="NAME", help="namespace of the graph")
    priority = "SCHED_FIFO priority, that of the graph's nodes (default: normal scheduling)"
    add("--priority", type=int, default=0, metavar="N", help=priority)
    add("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Serve until SIGINT or SIGTERM."""
    require_ros()
    check_range("--port", options.port, 0, 65535)
    if not re.fullmatch(_NAMESPACE, options.namespace):
        allowed = "letters, digits and _, e.g. stage_1 or cell/stage_1"
        raise CommandFailed(f"--namespace {options.namespace!r}; allowed: {allowed}", exit_code=2)
    realtime = from_mapping(RealtimeParameters, {"priority": options.priority})
    from straightcomp_ros.nodes.view_node import view

    arguments = ["--ros-args", "-r", f"__ns:=/{options.namespace.strip('/')}"] if options.namespace else []

    def ready(url: str) -> None:
        if options.json:
            print_json({"url": url})
        else:
            print(url)
        sys.stdout.flush()

    return view(options.port, ready, realtime, arguments)
