"""Starts the nodes as processes of their own, watches them, and stops them: what `ros2 launch` does, without it.

It imports no ROS: executables are found as `ros2 run` finds them, through the ament index; without an
installed package the modules are run by this Python.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from straightcomp_ros.contract import PACKAGE

_STOP_WITHIN_S = 5.0
_PR_SET_PDEATHSIG = 1


class LaunchError(RuntimeError):
    """A node could not be started, died, or did not stop; the message says which, and how it ended."""


def ros_available() -> bool:
    """Whether rclpy can be imported here."""
    return importlib.util.find_spec("rclpy") is not None


def executable_command(executable: str) -> list[str]:
    """How to start an executable of this package, e.g. ``driver_node``."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix) / "lib" / PACKAGE / executable
        if prefix and os.access(path, os.X_OK):
            return [str(path)]
    return [sys.executable, "-m", f"{PACKAGE}.nodes.{executable}"]


def verb_command(verb: str, *arguments: str) -> list[str]:
    """How to start a verb of `straightcomp` with this Python."""
    return [sys.executable, "-m", f"{PACKAGE}.cli.main", verb, *arguments]


def isolated_environment() -> dict[str, str]:
    """This environment, with traffic kept on this machine and, where none is set, a ROS domain of its own."""
    environment = dict(os.environ)
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    # 1 to 101 are free of the ports that Linux gives out by itself.
    environment.setdefault("ROS_DOMAIN_ID", str(random.SystemRandom().randint(1, 101)))
    return environment


class Graph:
    """Processes of one graph, by default in an :func:`isolated_environment`; as a context manager it stops them all.

    ``log_folder`` gets a file for each node with what it printed.
    """

    def __init__(self, log_folder: Path, environment: Mapping[str, str] | None = None) -> None:
        self._log_folder = log_folder
        self._environment = dict(environment or isolated_environment())
        self._processes: dict[str, subprocess.Popen[str]] = {}
        log_folder.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Graph:
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def start(
        self,
        name: str,
        parameters: Mapping[str, Any],
        parameter_file: Path | None = None,
        *,
        command: Sequence[str] | None = None,
        read_output: bool = False,
    ) -> subprocess.Popen[str]:
        """Start the node ``name`` by its executable ``<name>_node``, or by another ``command``.

        ``parameters`` win over those of the ROS 2 ``parameter_file``; for ``read_output`` see :meth:`start_program`.
        """
        words = [*(command or executable_command(f"{name}_node")), "--ros-args"]
        if parameter_file:
            words += ["--params-file", str(parameter_file)]
        for key, value in parameters.items():
            # Quoted, a text stays a text in the YAML of the command line ("1" or "on" would turn into something else).
            words += ["-p", f"{key}:={json.dumps(value, ensure_ascii=False)}"]
        return self.start_program(name, words, read_output=read_output)

    def start_program(self, name: str, command: Sequence[str], *, read_output: bool = False) -> subprocess.Popen[str]:
        """Start a program under a ``name`` of its own; one that is started again goes on with its log.

        With ``read_output`` standard output is a pipe for the caller instead of going to the log.
        """
        with self.log(name).open("a" if name in self._processes else "w") as log:
            process = subprocess.Popen(
                command,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE if read_output else log,
                stderr=log,
                text=True,
                preexec_fn=_end_with_parent,
                # Linux shares CPUs out among sessions first (sched_autogroup): in the terminal's own, all nodes
                # together would get as much as one other program, of whatever niceness.
                start_new_session=True,
            )
        self._processes[name] = process
        return process

    def log(self, name: str) -> Path:
        """The file with what the node printed."""
        return self._log_folder / f"{name}.log"

    def check(self, names: Sequence[str]) -> None:
        """Raise LaunchError if one of these nodes, which should run on, has ended."""
        for name in names:
            if (code := self.exit_code(name)) is not None:
                raise LaunchError(f"node '{name}' ended with {exit_words(code)}: {self.last_words(name)}")

    def exit_code(self, name: str) -> int | None:
        """How a node has ended, None while it runs."""
        return self._processes[name].poll()

    def last_words(self, name: str) -> str:
        """The last line that a node printed, for a message."""
        lines = [line for line in self.log(name).read_text(errors="replace").splitlines() if line.strip()]
        return lines[-1].strip() if lines else "it printed nothing"

    def stop(self, names: Sequence[str] | None = None) -> dict[str, int]:
        """Interrupt the named nodes (all, if None), wait until they are gone; returns their exit codes."""
        stopping = {name: self._processes.pop(name) for name in (names or list(self._processes))}
        for process in stopping.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + _STOP_WITHIN_S
        for process in stopping.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdout:
                process.stdout.close()
        return {name: process.returncode for name, process in stopping.items()}


def exit_words(code: int) -> str:
    """How a process ended, in words."""
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def _end_with_parent() -> None:
    # Nodes of a launcher that was killed must not run on: a spinning orphan spoils every later run.
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
