"""Runs the graph's processes for one cycle of the stage: starts them, follows the cell to its end, stops them."""

import select
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from straightcomp_ros.cell.launcher import Graph, LaunchError, exit_words

RECORDED = ("driver", "feedforward", "controller", "logger")
"""The nodes that must run as long as the cell does."""
IN_THE_LOOP = ("driver", "feedforward", "controller")
"""Those of them whose delays move the platform."""
_SLACK_S = 90.0
"""Time for start, discovery and delays of a busy machine, beyond the duration of the cycle itself."""


def run_cycle(
    bag: Path,
    parameter_file: Path,
    logs: Path,
    duration: float,
    progress: Callable[[float], object],
    *,
    started: Callable[[Mapping[str, int]], None] = lambda process_ids: None,
    commands: Mapping[str, Sequence[str]] | None = None,
    beside: Mapping[str, Sequence[str]] | None = None,
    in_place_of_cell: Sequence[str] | None = None,
    namespace: str = "",
) -> None:
    """Run the graph until the cell has finished its cycle, and record it.

    Args:
        bag, logs: folder that the logger makes; folder for the output of the nodes.
        parameter_file: of all nodes.
        duration: of the cycle, s.
        progress: called about 20 times a second with the finished fraction of the cycle; True ends the cycle now.
        started: called once with the process id of each node.
        commands: by node, a command to start instead of the node's executable.
        beside: by name, programs to start before the nodes, which need them: a bus, an emulated board.
        in_place_of_cell: a program that runs the cycle from outside the graph and prints its progress like the cell.
        namespace: of all nodes.

    Raises:
        LaunchError: a node died, the cycle failed or did not end, or the logger did not finish its bag.
    """
    commands, beside = commands or {}, beside or {}
    with Graph(logs, namespace=namespace) as graph:
        for name, command in beside.items():
            graph.start_program(name, command)
        ids = {}
        for name in RECORDED:
            extra = {"output": str(bag)} if name == "logger" else {}
            ids[name] = graph.start(name, extra, parameter_file, command=commands.get(name)).pid
        if in_place_of_cell:
            cell = graph.start_program("cell", in_place_of_cell, read_output=True)
        else:
            extra, command = {"progress": True}, commands.get("cell")
            cell = graph.start("cell", extra, parameter_file, command=command, read_output=True)
        started(ids)
        _follow(graph, cell, (*beside, *RECORDED), time.monotonic() + duration + _SLACK_S, progress)
        # The other nodes publish their last incomplete batches when they end.
        codes = graph.stop([name for name in RECORDED if name != "logger"]) | graph.stop(["logger"])
        if codes["logger"] != 0:
            raise LaunchError(f"logger: {exit_words(codes['logger'])}: {graph.last_words('logger')}")
        # The bag is complete and the amplifier is off now, so how the other nodes ended does not affect the result.
        for name, code in codes.items():
            if code != 0:
                print(f"node '{name}' did not stop cleanly: {exit_words(code)}", file=sys.stderr)


def _follow(
    graph: Graph, cell: Any, watched: Sequence[str], deadline: float, progress: Callable[[float], object]
) -> None:
    """Pass on the cell's progress until the cell ends or ``progress`` returns True; LaunchError if a node fails."""
    while cell.poll() is None:
        graph.check(watched)
        if time.monotonic() > deadline:
            raise LaunchError("the cycle did not end in time")
        if select.select([cell.stdout], [], [], 0.2)[0]:
            word, _, fraction = cell.stdout.readline().partition(" ")
            if word == "progress" and progress(float(fraction)) is True:
                return
    if cell.returncode != 0:
        raise LaunchError(f"cell: {graph.last_words('cell')}")
