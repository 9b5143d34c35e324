"""Kills a node at a random time of a cell's cycle, and collects what everybody says of it: the cell and the bag."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from straightcomp_ros.analysis.judgement import IN_ORDER
from straightcomp_ros.cell.launcher import RECORDED, Graph, LaunchError, verb_command
from straightcomp_ros.model.motion import cycles
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import as_parameter_file

_START_S = 90.0
_ENDS_WITHIN_S = 60.0
_POLL_S = 0.02


class Kill(NamedTuple):
    """What followed a kill.

    Attributes:
        node, at: which was killed, and when, s after the cell had started the stage's motion.
        cell, exit_code: the cell's last line, and its exit code; None if it did not end.
        bag: the folder of the logger.
        evaluate, history: last line and exit code of these verbs on the bag.
    """

    node: str
    at: float
    cell: str
    exit_code: int | None
    bag: str
    evaluate: str
    history: str

    @property
    def named(self) -> bool:
        """Whether the cell failed and named the node."""
        return self.exit_code == 1 and self.node in self.cell

    @property
    def judged(self) -> bool:
        """Whether neither `evaluate` nor the history calls the run in order."""
        return '"exit_code": 0' not in self.evaluate and IN_ORDER not in self.history


def run_kills(
    values: Mapping[str, Mapping[str, Any]],
    folder: Path,
    count: int,
    progress: Callable[[str, float], None] = lambda name, fraction: None,
    seed: int = 0,
) -> list[Kill]:
    """Run ``count`` cycles and kill in each one of the recorded nodes, in turn; bags and logs stay in ``folder``.

    Raises:
        LaunchError: the stage does not begin to move.
    """
    draw, kills = random.Random(seed), []
    motion = node_parameters("cell", values).stage.motion
    for number in range(count):
        node = RECORDED[number % len(RECORDED)]
        progress(f"{node} SIGKILL", number / count)
        at = draw.uniform(0.0, cycles(motion, 1)[-1].time_ns * 1e-9)
        kills.append(_killed(values, folder / f"kill_{number}_{node}", node, at))
    return kills


def _killed(values: Mapping[str, Mapping[str, Any]], folder: Path, node: str, at: float) -> Kill:
    folder.mkdir(parents=True)
    file, bag = folder / "parameters.yaml", folder / "bag"
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
    return Kill(
        node,
        at,
        graph.last_words("cell"),
        code,
        str(bag),
        _said("evaluate", str(bag)),
        _in_history(bag, folder / "store"),
    )


def _in_history(bag: Path, store: Path) -> str:
    """What a history with this bag alone says of its last stroke, or why it refuses the bag."""
    added = _said("history", "add", str(bag), "-o", str(store))
    last = "SELECT verdict, reason, faults FROM strokes ORDER BY stroke DESC LIMIT 1"
    return _said("history", "query", str(store), last, "--json") if '"exit_code": 0' in added else added


def _said(*words: str) -> str:
    done = subprocess.run(verb_command(*words), capture_output=True, text=True, check=False)
    lines = [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    return json.dumps({"exit_code": done.returncode, "last_line": lines[-1] if lines else ""}, ensure_ascii=False)
