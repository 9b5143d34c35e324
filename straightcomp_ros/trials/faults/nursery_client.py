"""The other end of :mod:`~.nursery`: processes that are started as forks of one that has loaded everything."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from straightcomp_ros.cell.launcher import LaunchError
from straightcomp_ros.trials.faults.nursery import TELL_STACKS

_STOP_S = 10.0


class Nursery:
    """It loads the nodes' modules from its making on, in a process of its own; the first start waits for that."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "straightcomp_ros.trials.faults.nursery"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._codes: dict[int, int] = {}

    def start(self, words: Sequence[str], log: Path) -> int:
        """Start a module of :mod:`straightcomp_ros.nodes` with arguments; returns its process id.

        Raises:
            LaunchError: the modules cannot be loaded.
        """
        return int(self._ask({"start": list(words), "log": str(log)})["pid"])

    def exit_code(self, process_id: int) -> int | None:
        """How a process has ended, None while it runs."""
        if process_id not in self._codes:
            code = self._ask({"wait": process_id})["code"]
            if code is None:
                return None
            # The nursery tells it once.
            self._codes[process_id] = code
        return self._codes[process_id]

    def tell_stacks(self, process_id: int) -> None:
        """Have it write into its log where its threads are."""
        os.kill(process_id, TELL_STACKS)

    def close(self) -> None:
        """End all that was started."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise LaunchError("the nodes' modules cannot be loaded; is the package whole?")
        return dict(json.loads(line))
