"""Serve a page on this machine with live plots of the running graph, its state and faults, and buttons.

Open the address that is printed in a browser; the part behind the # is the token that the buttons need. The view is a
process of its own and only watches. Where the graph's nodes run with real-time priority, give --priority the same."""

import argparse
import math
import sys
from pathlib import Path

from straightcomp_ros.cli.options import add_json, add_namespace, in_range
from straightcomp_ros.cli.output import CommandFailed, print_json, require_ros

SUMMARY = "live plots of the running graph in a browser"
PURPOSE = "run"
DEFAULT_PORT = 8765


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    port = "port on 127.0.0.1; 0 takes a free one (default: %(default)s)"
    add("--port", type=in_range(int, 0, 65535), default=DEFAULT_PORT, help=port)
    add_namespace(parser)
    priority = "SCHED_FIFO priority, that of the graph's nodes (default: normal scheduling)"
    add("--priority", type=int, default=0, metavar="N", help=priority)
    advice = "show the advice of `straightcomp history advise` in this file"
    add("--maintenance", default="", metavar="FILE", help=advice)
    limits = "show the limit of encoder_pp_um in this file with the error, e.g. the limits.yaml next to a certificate"
    add("--limits", default="", metavar="FILE", help=limits)
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Serve until SIGINT, SIGTERM or SIGHUP."""
    from straightcomp_ros.cell.launcher import in_namespace
    from straightcomp_ros.parameters.declaration import from_mapping
    from straightcomp_ros.timing.realtime import RealtimeParameters

    require_ros()
    realtime = from_mapping(RealtimeParameters, {"priority": options.priority})
    from straightcomp_ros.nodes.view_node import ViewNode
    from straightcomp_ros.runtime.runner import run as run_node

    limit = {"um": largest_error(options.limits), "source": Path(options.limits).name} if options.limits else None
    arguments = ["--ros-args", *in_namespace(options.namespace)] if options.namespace else []

    def ready(url: str) -> None:
        if options.json:
            print_json({"url": url})
        else:
            print(url)
        sys.stdout.flush()

    return run_node(
        "view", lambda node: ViewNode(node, options.port, ready, realtime, options.maintenance, limit), arguments
    )


def largest_error(file: str) -> float:
    """The largest error p-p in µm by a file of limits; CommandFailed where it has none."""
    from straightcomp_ros.analysis.assessment import checked_limits

    found = {one.name: one.maximum for one in checked_limits(file)}
    if not math.isfinite(found.get("encoder_pp_um", math.inf)):
        raise CommandFailed(f"limits {file}: has no maximum of encoder_pp_um, which the view shows", exit_code=2)
    return found["encoder_pp_um"]
