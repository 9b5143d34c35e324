"""The running graph as a test stand for faults: starts it, moves the stage, injects faults, sees what is latched."""

from __future__ import annotations

import math
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.cell.launcher import COMPOSED, IN_THE_LOOP, RECORDED, Graph, LaunchError, isolated_environment
from straightcomp_ros.contract import POSITION, SAFETY_STATE, STAGE_TRAJECTORY, TRIP
from straightcomp_ros.model.motion import MotionParameters, cycles
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.runtime.graph_client import Heartbeats, ServiceClient, message_from_waypoints
from straightcomp_ros.runtime.middleware import own_profile
from straightcomp_ros.runtime.safety_panel import LATCHED
from straightcomp_ros.runtime.streams import message_class, stream_qos
from straightcomp_ros.safety.faults import LABELLED, Fault
from trials.faulty_driver import INJECT, INJECTED, NEW_MACHINE, FaultyDriver
from trials.foreign_publisher import publish

_START_S = 90.0
"""Time limit, since a busy computer takes long to start a node, and the middleware to connect it."""
PATIENCE_S = 8.0
"""Time limit of what a working graph does at once."""
_NEW_DRIVER_S = 30.0
_ANSWER_S = 3.0
_REPLY_S = 1.0
"""Time limit of one request: it is lost if it goes to a killed node that is still known."""
_SETTLE_S = 0.1
_REQUESTS, _REFUSALS = 3, 2
_AT_THE_STOP = (Fault.Y_OUT_OF_RANGE, Fault.Y_FROZEN)
STOP_S = 30.0
SILENT_AFTER_S = 1.0
"""Time in s after its last heartbeat from which a node counts as silent here."""
_SPAWN = get_context("spawn")


class Seen(NamedTuple):
    """A fault, and the time at which it was latched, ns since the epoch."""

    fault: Fault
    time_ns: int


class Stand:
    """The graph's processes; this context manager stops them at its end.

    Args:
        folder: gets bags, logs and the parameter file.
        values: parameters by node and dotted name.
        composed: driver, feedforward and controller run in one process.

    Attributes:
        graph: starts and stops the processes; it may get others.
        failures: what was not as it must be, in words; ``about`` begins those that follow.
        condition, fault: of the driver's safety state; ``tripped``: the fault for which the controller asked to switch
            off; ``injected_ns``: when the driver began an injected fault.
        x, farthest, hard_stop: x in m, largest |y| in m since foreign commands began, and |y| at the mechanical stop.
        answers_lost: service requests that were not answered in time.

    Raises:
        LaunchError: the graph does not start.
    """

    def __init__(self, folder: Path, values: Mapping[str, Mapping[str, Any]], composed: bool = False) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._file = folder, folder / "parameters.yaml"
        self._file.write_text(as_parameter_file(values))
        os.environ.update(isolated_environment())
        self.graph = Graph(folder)
        self.failures: list[str] = []
        self.about = ""
        self.process_of = {name: COMPOSED if composed and name in IN_THE_LOOP else name for name in RECORDED}
        self.names = tuple(dict.fromkeys(self.process_of.values()))
        self.processes: dict[str, int] = {}
        self.started: dict[str, float] = {}
        self.condition, self.fault, self.tripped = "", None, None
        self.injected_ns = self.answers_lost = self._bags = 0
        self.x, self.farthest, self.hard_stop = 0.0, 0.0, node_parameters("driver", values).stage.platform.stop
        with own_profile():
            rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
            self.node = Node("fault_stand")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.heartbeats = Heartbeats(self.node, RECORDED, SILENT_AFTER_S)
        self.node.create_subscription(DiagnosticStatus, SAFETY_STATE, self._on_safety_state, LATCHED)
        self.node.create_subscription(DiagnosticStatus, TRIP, self._on_trip, 10)
        self.node.create_subscription(DiagnosticStatus, INJECTED, self._on_injected, 10)
        self._inject = self.node.create_publisher(DiagnosticStatus, INJECT, 10)
        self._trajectory = self.node.create_publisher(JointTrajectory, STAGE_TRAJECTORY, 10)
        kind, unpack = message_class(POSITION.layout.type_name), POSITION.layout.unpack
        self.node.create_subscription(
            kind, POSITION.topic, lambda data: self._on_position(*unpack(data)), stream_qos(), raw=True
        )
        self._clients: dict[str, ServiceClient] = {}

    def __enter__(self) -> Stand:
        for name in self.names:
            self.start(name)
        return self

    def __exit__(self, *_: object) -> None:
        self.graph.stop()
        self.node.destroy_node()
        rclpy.try_shutdown()

    def start(self, name: str) -> None:
        """Start a node; start it again if it has ended."""
        parameters, command = {}, None
        if name == self.process_of["driver"]:
            command = [sys.executable, "-m", FaultyDriver.__module__, name]
        if name == "logger":
            self._bags += 1
            parameters["output"] = str(self.bag)
        for node, process in self.process_of.items():
            self.heartbeats.ages[node] = math.inf if process == name else self.heartbeats.ages[node]
        self.started[name] = time.monotonic()
        self.processes[name] = self.graph.start(name, parameters, self._file, command=command).pid

    def restart(self, name: str) -> None:
        """Start a killed node again once its process has ended; a new driver's amplifier must be off."""
        if any(self.graph.exit_code(other) is not None for other in self.names if other != name):
            self.fail("another node has ended too")
        self.until(lambda: self.graph.exit_code(name) is not None, STOP_S)
        drives = name == self.process_of["driver"]
        if drives:
            self.condition = ""
        self.start(name)
        if drives and (not self.until(lambda: self.condition != "", _NEW_DRIVER_S) or self.condition == "on"):
            self.fail(f"the new driver's amplifier is '{self.condition}'")

    def stop(self) -> dict[str, int]:
        """Stop all nodes as an operator does, the logger last; their exit codes, negative for one that was killed."""
        others = [name for name in self.names if name != "logger"]
        return self.graph.stop(others) | self.graph.stop(["logger"])

    @property
    def bag(self) -> Path:
        """Folder of the newest logger's bag."""
        return self._folder / f"bag_{self._bags}"

    def signal(self, name: str, number: signal.Signals) -> int:
        """Send a signal to a node; returns the time, ns since the epoch."""
        at_ns = time.time_ns()
        os.kill(self.processes[name], number)
        return at_ns

    def spin(self, seconds: float) -> None:
        """Spin for this time."""
        self.until(lambda: False, seconds)

    def until(self, condition: Callable[[], bool], seconds: float = PATIENCE_S) -> bool:
        """Wait for a condition, at most for the given time; returns whether it became true."""
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=0.01)
        return True

    def foreign(self, *own: float) -> int:
        """Let a process of its own publish commands, see :func:`trials.foreign_publisher.publish`; returns when the
        first was sent, ns since the epoch."""
        self._foreign, theirs = _SPAWN.Pipe()
        _SPAWN.Process(target=publish, args=(theirs, *own), daemon=True).start()
        theirs.close()
        self.farthest = 0.0
        return int(self._foreign.recv())

    def foreign_ended(self) -> int:
        """End that process; returns the number of its commands."""
        self._foreign.send(None)
        return int(self._foreign.recv())

    def inject(self, kind: str) -> None:
        """Request a fault from the driver; an empty text ends it."""
        self._inject.publish(DiagnosticStatus(name=kind))

    def enable(self) -> bool:
        """Request the amplifier; returns whether it was switched on."""
        answer = self.request(SetBool, "driver/enable", data=True)
        return answer is not None and answer.success

    def fail(self, words: str) -> None:
        """Note what is not as it must be."""
        self.failures.append(self.about + words)

    def must_not_switch_on(self) -> None:
        """Check that a fault is latched."""
        if self.enable():
            self.fail("the fault was not latched: the amplifier could be switched on")

    def move(self) -> None:
        """Start the forth and back. The driver refuses it if the stage is not where it begins, and while it moves."""
        self._trajectory.publish(_MOTION)

    def switch_on(self) -> None:
        """Bring the whole graph to its working state: all nodes active, stage moving, amplifier on.

        Raises:
            LaunchError: the graph does not reach that state.
        """
        deadline, refusals = time.monotonic() + _START_S, 0
        while time.monotonic() < deadline:
            self.inject("")
            if not self.until(lambda: self.active, _ANSWER_S):
                self.graph.check(self.names)
                continue
            self.spin(0.03)
            self.request(Trigger, "driver/reset_fault")
            self.move()
            refusals += 1
            if refusals % _REFUSALS == 0 and self.fault is not None and self.fault.fault in _AT_THE_STOP:
                # The platform may be at its mechanical stop, where no law gets it off.
                self.inject(NEW_MACHINE)
                continue
            if self.enable() and self.until(lambda: self.condition == "on", 1.0):
                self.spin(_SETTLE_S)
                if self.condition == "on":
                    self.fault = self.tripped = None
                    self.injected_ns = 0
                    return
        raise LaunchError(
            f"the graph does not come up: nodes {self.heartbeats.states}, amplifier '{self.condition}', "
            f"fault {self.fault} (logs in {self._folder})"
        )

    @property
    def active(self) -> bool:
        """Whether all nodes are."""
        return not self.heartbeats.silent() and set(self.heartbeats.states.values()) == {"active"}

    def request(self, kind: Any, service: str, **fields: Any) -> Any:
        """Call a service of a node with these fields once; its answer, or None without one, at once from a node that
        has ended."""
        if service not in self._clients:
            client = self._clients[service] = ServiceClient(self.node, kind, service)
            self.until(lambda: client.ready, _ANSWER_S)
        process = self.process_of[service.split("/")[0]]
        future = self._clients[service].call(kind.Request(**fields))
        if not self.until(lambda: future.done() or self.graph.exit_code(process) is not None, _REPLY_S):
            self.answers_lost += 1
        return future.result()

    def call(self, kind: Any, service: str, **fields: Any) -> Any:
        """The answer of a service of a node, of up to :data:`_REQUESTS` requests: a node that has just started may lose
        the request or its answer. LaunchError without one."""
        for _ in range(_REQUESTS):
            if (answer := self.request(kind, service, **fields)) is not None:
                return answer
        raise LaunchError(f"'{service}' does not answer")

    def set(self, node: str, values: Mapping[str, Any]) -> Any:
        """Set parameters of a node, all or none; returns the node's result."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        return self.call(SetParametersAtomically, f"{node}/set_parameters_atomically", parameters=parameters).result

    def _on_safety_state(self, message: DiagnosticStatus) -> None:
        values = {value.key: value.value for value in message.values}
        self.condition = values["condition"]
        if message.name:
            self.fault = Seen(LABELLED[message.name], int(values["time_ns"]))

    def _on_position(self, _: int, numbers: Sequence[float]) -> None:
        self.x, self.farthest = numbers[0], max(self.farthest, abs(numbers[1]))

    def _on_trip(self, message: DiagnosticStatus) -> None:
        # Any program may publish here.
        if message.name in LABELLED:
            self.tripped = Seen(LABELLED[message.name], time.time_ns())

    def _on_injected(self, message: DiagnosticStatus) -> None:
        self.injected_ns = int(message.values[0].value)


_STROKES = MotionParameters(stroke=0.1, speed=0.1, acceleration=0.4, settle=0.0, pause=0.0)
_MOTION = message_from_waypoints(list(dict.fromkeys(cycles(_STROKES, 300))))
"""Forward and backward in turn, without a rest."""
