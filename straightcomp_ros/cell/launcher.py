"""Starts the nodes as separate processes, watches them, and stops them, like `ros2 launch` but without it.

It imports no ROS: like `ros2 run` it finds executables through the ament index. If no installation of the package is
sourced, this Python runs the nodes of its own.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import os
import random
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from straightcomp_ros.parameters.share import PACKAGE

RECORDED = ("driver", "feedforward", "controller", "logger")
"""The nodes that must run as long as the cell does."""
IN_THE_LOOP = ("driver", "feedforward", "controller")
"""Those of them whose delays move the platform."""
COMPOSED = "servo"
"""The process in which these run, if they run in one."""
CLIENTS = ("cell", "opcua")
"""Programs that move the machine. They switch the amplifier off when they are stopped, and need the driver for that."""
SLACK_S = 700.0
"""Time for start, discovery and delays of a busy machine, beyond the duration of the cycle itself. A process that ends
is seen at once, and what waits for the others gives up before."""
_STOP_WITHIN_S = 30.0
"""Beyond what a busy machine or a slow disk takes: a logger that is killed leaves a bag without its index."""
_PR_SET_PDEATHSIG = 1
ROS_REMEDY = "source a ROS 2 Jazzy installation, or: pip install 'straightcomp_ros[ros]'"


class LaunchError(RuntimeError):
    """A node could not be started, died, or did not stop; the message names the node and how it ended."""


def ros_available() -> bool:
    """Whether there is an rclpy here; of another distribution or Python it cannot be imported."""
    return importlib.util.find_spec("rclpy") is not None


def without_ros(error: ImportError) -> str:
    """What is wrong and what to do where ``error`` is of a module of ROS; else empty."""
    ours = re.match(r"(rclpy|rpyutils|ament_\w+|rosidl_\w+|\w+_(msgs|srvs|interfaces))\b", error.name or "")
    return f"{error}; {ROS_REMEDY}" if ours else ""


def executable_command(executable: str) -> list[str]:
    """Command that starts an executable of this package, e.g. ``driver_node``; LaunchError if the sourced installation
    lacks it."""
    for prefix in map(Path, filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))):
        if (prefix / "share/ament_index/resource_index/packages" / PACKAGE).exists():
            installed = prefix / "lib" / PACKAGE / executable
            if os.access(installed, os.X_OK):
                return [str(installed)]
            remedy = f"colcon build --packages-select {PACKAGE}, then source the workspace again"
            raise LaunchError(f"executable '{executable}' is missing in {installed.parent}; remedy: {remedy}")
    return program(f"from {PACKAGE}.nodes.start import {executable}; raise SystemExit({executable}())")


def verb_command(verb: str, *arguments: str) -> list[str]:
    """Command that starts a verb of `straightcomp` with this Python."""
    return [*program(f"from {PACKAGE}.cli.main import main; raise SystemExit(main())"), verb, *arguments]


def program(code: str) -> list[str]:
    """Command that runs Python code with this very package, whatever lies in the working directory, which `python -c`
    puts first on Python's path as an empty name."""
    root = str(Path(__file__).parents[2])
    path = f"sys.path = [*filter(None, sys.path)]; {root!r} in sys.path or sys.path.insert(0, {root!r})"
    return [sys.executable, "-c", f"import sys; {path}\n{code}"]


def in_namespace(namespace: str) -> list[str]:
    """ROS arguments, to follow ``--ros-args``, that put a node into ``namespace``; none for an empty one."""
    return ["-r", f"__ns:=/{namespace.strip('/')}"] if namespace else []


def free_domain(among: Sequence[int] = range(1, 102)) -> str:
    """A random ROS domain in which no process of this computer takes part; LaunchError if each has one.

    The ports of domains 1 to 101 do not collide with Linux's ephemeral ports.
    """
    for domain in random.SystemRandom().sample(among, len(among)):
        try:
            for participant in range(32):
                # Discovery of a participant listens at 7400 + 250 domain + 10 + 2 participant (RTPS 2.5, 9.6.2.3).
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
                    listener.bind(("", 7410 + 250 * domain + 2 * participant))
        except OSError:
            continue
        return str(domain)
    raise LaunchError(f"each ROS domain from {min(among)} to {max(among)} is in use on this computer")


def isolated_environment() -> dict[str, str]:
    """This environment, with discovery limited to this computer and, unless one is set, a ROS domain that is free."""
    domain = os.environ["ROS_DOMAIN_ID"] if "ROS_DOMAIN_ID" in os.environ else free_domain()
    return {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", **os.environ, "ROS_DOMAIN_ID": domain}


class Graph:
    """Processes of one graph, by default in an :func:`isolated_environment`; as a context manager it stops them all.

    ``log_folder`` gets a file with the output of each node; ``namespace`` is that of all nodes.
    """

    def __init__(self, log_folder: Path, environment: Mapping[str, str] | None = None, namespace: str = "") -> None:
        self._log_folder, self._namespace = log_folder, namespace
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

        ``parameters`` override those of the ROS 2 ``parameter_file``; for ``read_output`` see :meth:`start_program`.
        """
        words = [*(command or executable_command(f"{name}_node")), "--ros-args", *in_namespace(self._namespace)]
        if parameter_file:
            words += ["--params-file", str(parameter_file)]
        for key, value in parameters.items():
            # Quotes keep a text a text in the command line's YAML, which would convert "1" or "on".
            words += ["-p", f"{key}:={json.dumps(value, ensure_ascii=False)}"]
        return self.start_program(name, words, read_output=read_output)

    def start_program(self, name: str, command: Sequence[str], *, read_output: bool = False) -> subprocess.Popen[str]:
        """Start a program under the log name ``name``; a program that is started again appends to its log.

        With ``read_output`` its standard output is a pipe for the caller, and is not in the log.
        """
        with self.log(name).open("a" if name in self._processes else "w") as log:
            process = subprocess.Popen(
                command,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE if read_output else log,
                stderr=log,
                text=True,
                preexec_fn=_begin_as_child,
                # Linux divides CPUs among sessions first (sched_autogroup): in the terminal's session, all nodes
                # together would get as much CPU time as one other program, whatever its niceness.
                start_new_session=True,
            )
        self._processes[name] = process
        return process

    def log(self, name: str) -> Path:
        """The file with the node's output."""
        return self._log_folder / f"{name}.log"

    def check(self, names: Sequence[str]) -> None:
        """Raise LaunchError if one of these nodes, which must keep running, has ended."""
        for name in names:
            if (code := self.exit_code(name)) is not None:
                raise LaunchError(f"node '{name}' ended with {exit_words(code)}: {self.last_words(name)}")

    def exit_code(self, name: str) -> int | None:
        """A node's exit code; None while it runs."""
        return self._processes[name].poll()

    def last_words(self, name: str) -> str:
        """The last line of a node's output, for a message."""
        lines = self.log(name).read_text(errors="replace").strip().splitlines()
        return lines[-1].strip() if lines else "it printed nothing"

    def stop(self, names: Sequence[str] | None = None) -> dict[str, int]:
        """Interrupt the named nodes (None: all, first the clients among them) and wait for their ends; returns their
        exit codes."""
        if names is None:
            return self.stop([name for name in CLIENTS if name in self._processes]) | self.stop([*self._processes])
        stopping = {name: self._processes.pop(name) for name in names}
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


def _begin_as_child() -> None:
    # A launcher in the background of a script ignores SIGINT, and what inherited that could only be killed.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Nodes must not outlive a launcher that was killed: orphans would disturb every later run.
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def run_cycle(
    bag: Path,
    parameter_file: Path,
    logs: Path,
    duration: float,
    progress: Callable[[float], object],
    *,
    started: Callable[[Mapping[str, int]], None] = lambda process_ids: None,
    programs: Mapping[str, Sequence[str]] | None = None,
    in_place_of_cell: Sequence[str] | None = None,
    namespace: str = "",
    environment: Mapping[str, str] | None = None,
    composed: bool = False,
) -> list[str]:
    """Start the graph, follow the cell to the end of its cycle of ``duration`` s, and stop it; ``bag`` has the record.

    Args:
        logs: folder for the output of the nodes.
        progress: called about 20 times a second with the finished fraction of the cycle; True ends the cycle now.
        started: called once with the id of each process, by the name of its node or of :data:`COMPOSED`.
        programs: commands by name, to start before the nodes, which need them: a bus, an emulated board.
        in_place_of_cell: a program that runs the cycle from outside the graph and prints its progress like the cell.
        environment: of the processes; by default an :func:`isolated_environment`.
        composed: run driver, feedforward and controller in one process.

    Returns:
        A sentence, printed too, for each node but the logger that did not end by itself when it was asked to.

    Raises:
        LaunchError: a node died, the cycle failed or did not end, or the logger did not finish its bag.
    """
    programs = programs or {}
    processes = (COMPOSED, "logger") if composed else RECORDED
    with Graph(logs, environment, namespace) as graph:
        for name, command in programs.items():
            graph.start_program(name, command)
        ids = {}
        for name in processes:
            extra = {"output": str(bag)} if name == "logger" else {}
            ids[name] = graph.start(name, extra, parameter_file).pid
        if in_place_of_cell:
            cell = graph.start_program("cell", in_place_of_cell, read_output=True)
        else:
            cell = graph.start("cell", {"progress": True}, parameter_file, read_output=True)
        started(ids)
        deadline, finished = time.monotonic() + duration + SLACK_S, False
        while not finished and cell.poll() is None:
            graph.check((*programs, *processes))
            if time.monotonic() > deadline:
                raise LaunchError("the cycle did not end in time")
            if select.select([cell.stdout], [], [], 0.2)[0] and cell.stdout is not None:
                word, _, fraction = cell.stdout.readline().partition(" ")
                finished = word == "progress" and progress(float(fraction)) is True
        if not finished and cell.returncode != 0:
            raise LaunchError(f"cell: {graph.last_words('cell')}")
        # The other nodes publish their last incomplete batches when they end.
        codes = graph.stop([name for name in processes if name != "logger"]) | graph.stop(["logger"])
        if codes["logger"] != 0:
            raise LaunchError(f"logger: {exit_words(codes['logger'])}: {graph.last_words('logger')}")
        # The bag is complete and the amplifier is off now, so how the other nodes ended does not affect the figures.
        unclean = [f"node '{name}' did not stop cleanly: {exit_words(code)}" for name, code in codes.items() if code]
        for sentence in unclean:
            print(sentence, file=sys.stderr)
        return unclean
