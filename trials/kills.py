"""Run cycles of the cell, kill a node at a random time in each, and print what cell, evaluate and history report.

Exit code 1 if the cell did not end with code 1 and name the node, or a bag is called in order. Bags and logs stay in
the folder of --output."""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from straightcomp_ros.analysis.judgement import IN_ORDER
from straightcomp_ros.cell.launcher import RECORDED, Graph, LaunchError, verb_command
from straightcomp_ros.cli.options import add_parameter_options, check_range, chosen_parameters
from straightcomp_ros.cli.output import print_json, require_ros
from straightcomp_ros.model.motion import cycles
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from trials.rig import add_output, output, progress

SUMMARY = "kill nodes in cycles of the cell, and see who names it"
_START_S, _ENDS_WITHIN_S, _POLL_S = 90.0, 60.0, 0.02
_LAST_STROKE = "SELECT verdict, reason, faults FROM strokes ORDER BY stroke DESC LIMIT 1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    parser.add_argument("--kills", type=int, default=40, metavar="N", help="number of cycles (default: %(default)s)")
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    require_ros()
    check_range("--kills", options.kills, 1, 10_000)
    values, draw, kills = chosen_parameters(options), random.Random(0), []
    cycle_s = cycles(node_parameters("cell", values).stage.motion, 1)[-1].time_ns * 1e-9
    with output(options) as folder, progress() as advance:
        for number in range(options.kills):
            node = RECORDED[number % len(RECORDED)]
            advance(f"{node} SIGKILL", number / options.kills)
            kills.append(killed(values, folder / f"kill_{number}_{node}", node, draw.uniform(0.0, cycle_s)))
    print_json({"kills": kills})
    return int(not all(kill["named"] and kill["judged"] for kill in kills))


def killed(values: Mapping[str, Mapping[str, Any]], folder: Path, node: str, at: float) -> dict[str, Any]:
    """Kill ``node`` ``at`` s after the cell has started the stage's motion.

    Returns:
        Beside ``node`` and ``at`` the last line of the cell, and of `evaluate` and of the history on the bag, each with
        its exit code (None for a cell that did not end); ``named``: whether the cell failed and named the node;
        ``judged``: whether neither verb calls the run in order.

    Raises:
        LaunchError: the stage does not begin to move.
    """
    folder.mkdir(parents=True)
    file, bag, store = folder / "parameters.yaml", folder / "bag", str(folder / "store")
    file.write_text(as_parameter_file(values))
    with Graph(folder) as graph:
        ids = {one: graph.start(one, {"output": str(bag)} if one == "logger" else {}, file).pid for one in RECORDED}
        cell = graph.start("cell", {}, file)
        end = time.monotonic() + _START_S
        while "stage moves" not in graph.log("cell").read_text(errors="replace"):
            graph.check(("cell", *RECORDED))
            if time.monotonic() > end:
                raise LaunchError(f"the stage does not move (logs in {folder})")
            time.sleep(_POLL_S)
        time.sleep(at)
        os.kill(ids[node], signal.SIGKILL)
        try:
            code: int | None = cell.wait(_ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            code = None
        graph.stop([one for one in RECORDED if one not in (node, "logger")])
        words = graph.last_words("cell")
    evaluated, history = _last_line("evaluate", str(bag)), _last_line("history", "add", str(bag), "-o", store)
    if not history[0]:
        history = _last_line("history", "query", store, _LAST_STROKE, "--json")
    return {
        "node": node,
        "at": at,
        "cell": [code, words],
        "evaluate": evaluated,
        "history": history,
        "named": code == 1 and node in words,
        "judged": evaluated[0] != 0 and IN_ORDER not in history[1],
    }


def _last_line(*words: str) -> tuple[int, str]:
    done = subprocess.run(verb_command(*words), capture_output=True, text=True, check=False)
    lines = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    return done.returncode, lines[-1] if lines else ""
