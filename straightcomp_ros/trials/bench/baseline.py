"""The graph as plain rclpy nodes: what `straightcomp bench graph --baseline` compares the project's nodes with.

Timers and one callback for each message on a SingleThreadedExecutor; messages are built and read as objects. The parts
behind the callbacks, parameters, topics and rates are those of the real nodes. Only the logger takes bytes: one that
deserialises what it is to store would be a straw man.

    python -m straightcomp_ros.trials.bench.baseline NODE --ros-args …
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.configuration.node_parameters import (
    ControllerNodeParameters,
    DriverNodeParameters,
    FeedforwardNodeParameters,
    LoggerNodeParameters,
)
from straightcomp_ros.contract import (
    COMMAND,
    CONTROLLER_STATE,
    DIAGNOSTICS,
    DRIVER_STATE,
    ENCODER,
    PLATFORM,
    REFERENCE,
    SAFETY_STATE,
    STAGE,
    STAGE_TRAJECTORY,
    STREAMS,
    TRUTH,
    UNCONNECTED,
    Stream,
)
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.control.pairing import Pairing
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.messages.cdr import NANOSECONDS, header_stamp_ns
from straightcomp_ros.runtime.clock import now_ns
from straightcomp_ros.runtime.declare import declare
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.runtime.runner import EXIT_CONFIGURATION, run
from straightcomp_ros.runtime.safety_panel import LATCHED, safety_status
from straightcomp_ros.runtime.stage_trajectory import trajectory_from_message
from straightcomp_ros.runtime.streams import message_type, stream_qos
from straightcomp_ros.safety.state_machine import Condition
from straightcomp_ros.straightness.feedforward import Feedforward
from straightcomp_ros.straightness.guide_map import load_map
from straightcomp_ros.timing.gaps import StampGaps
from straightcomp_ros.timing.node_timing import AMPLIFIER, LOST, OVERRUNS, SAMPLES


class _Plain:
    """What the runner asks of a node, and a counter of the samples that it saw."""

    def __init__(self, node: Node, parameters: Any) -> None:
        self.node, self.done, self.realtime, self.loop = node, Future(), parameters.realtime, None
        self.samples = 0
        self.gaps = StampGaps()
        Diagnostics(node, self.counters)

    def counters(self) -> dict[str, object]:
        return {SAMPLES: self.samples, LOST: self.gaps.lost, OVERRUNS: 0}

    def saw(self, stamp_ns: int) -> None:
        self.samples += 1
        self.gaps.see(stamp_ns)

    def publisher(self, stream: Stream) -> Callable[[Any], None]:
        kind = message_type(stream.layout.type_name)
        return self.node.create_publisher(kind, stream.topic, stream_qos()).publish

    def subscribe(self, stream: Stream, callback: Callable[[Any], None]) -> None:
        self.node.create_subscription(message_type(stream.layout.type_name), stream.topic, callback, stream_qos())

    def close(self) -> None:
        """Nothing to make safe."""


class Driver(_Plain):
    """Reads the simulated machine on a timer."""

    def __init__(self, node: Node) -> None:
        parameters = declare(node, DriverNodeParameters)
        super().__init__(node, parameters)
        self._hardware = SimulatedHardware(parameters.simulated, load_map(parameters.guide))
        self._latency = math.nan
        self._encoder, self._truth, self._state = map(self.publisher, (ENCODER, TRUTH, DRIVER_STATE))
        self._safety = node.create_publisher(DiagnosticStatus, SAFETY_STATE, LATCHED)
        self._told: State | None = None
        self.subscribe(COMMAND, self._on_command)
        node.create_service(SetBool, "~/enable", self._on_enable)
        node.create_subscription(JointTrajectory, STAGE_TRAJECTORY, self._on_stage_trajectory, 10)
        self._hardware.start(now_ns())
        node.create_timer(1.0 / parameters.simulated.rate, self._on_timer)

    def _on_timer(self) -> None:
        for sample, truth in self._hardware.read(now_ns()):
            self.saw(sample.stamp_ns)
            encoder = JointState(
                name=[STAGE, PLATFORM], position=[sample.x, sample.y], effort=[math.nan, sample.current]
            )
            encoder.header.stamp = _time(sample.stamp_ns)
            self._encoder(encoder)
            self._truth(_variables(TRUTH, sample.stamp_ns, list(truth)))
            lateness = (now_ns() - sample.stamp_ns) * 1e-9
            on = 1.0 if self._hardware.state is State.ON else 0.0
            numbers = [self._latency, lateness, self._hardware.applied_current, on]
            self._state(_variables(DRIVER_STATE, sample.stamp_ns, numbers))
            self._latency = math.nan
        if self._hardware.state is not self._told:
            self._told = self._hardware.state
            self._safety.publish(safety_status(Condition(self._told.value), None, self.node.get_name()))

    def _on_command(self, message: JointState) -> None:
        now = now_ns()
        self._latency = (now - _stamp_ns(message)) * 1e-9
        self._hardware.write(message.effort[0], now, _stamp_ns(message))

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data:
            self._hardware.reset_fault()
            self._hardware.enable()
        else:
            self._hardware.disable()
        response.success = True
        return response

    def _on_stage_trajectory(self, message: JointTrajectory) -> None:
        self._hardware.move(trajectory_from_message(message), now_ns())

    def counters(self) -> dict[str, object]:
        counters = {**super().counters(), LOST: self._hardware.lost_samples, AMPLIFIER: self._hardware.state.value}
        return {**counters, "error": self._hardware.fault} if self._hardware.fault else counters

    def close(self) -> None:
        self._hardware.close()


class FeedforwardNode(_Plain):
    """Answers each sample with its reference."""

    def __init__(self, node: Node) -> None:
        parameters = declare(node, FeedforwardNodeParameters)
        super().__init__(node, parameters)
        self._feedforward = Feedforward(load_map(parameters.map), parameters.feedforward)
        self._publish = self.publisher(REFERENCE)
        self.subscribe(ENCODER, self._on_sample)

    def _on_sample(self, message: JointState) -> None:
        stamp_ns = _stamp_ns(message)
        self.saw(stamp_ns)
        r, r_dot, r_ddot = self._feedforward.step(stamp_ns, message.position[0])
        point = JointTrajectoryPoint(positions=[r], velocities=[r_dot], accelerations=[r_ddot])
        reference = JointTrajectory(joint_names=[PLATFORM], points=[point])
        reference.header.stamp = message.header.stamp
        self._publish(reference)


class Controller(_Plain):
    """Steps the law as each sample arrives."""

    def __init__(self, node: Node) -> None:
        parameters = declare(node, ControllerNodeParameters)
        super().__init__(node, parameters)
        self._servo = Servo(make_law(parameters.control, 1.0 / parameters.rate))
        self._pairing = Pairing(parameters.lead_ns, wait=False)
        self._command, self._state = self.publisher(COMMAND), self.publisher(CONTROLLER_STATE)
        self.subscribe(ENCODER, self._on_sample)
        self.subscribe(REFERENCE, self._on_reference)

    def _on_sample(self, message: JointState) -> None:
        stamp_ns = _stamp_ns(message)
        self.saw(stamp_ns)
        self._pairing.add_sample(stamp_ns, (message.position[1], message.effort[1]))
        self._answer()

    def _on_reference(self, message: JointTrajectory) -> None:
        point = message.points[0]
        reference = (point.positions[0], point.velocities[0], point.accelerations[0])
        self._pairing.add_reference(_stamp_ns(message), reference)
        self._answer()

    def _answer(self) -> None:
        for stamp_ns, (y, current), reference, age_ns in self._pairing.take():
            command = self._servo.step(stamp_ns, y, current, reference)
            if command is not None:
                message = JointState(name=[PLATFORM], effort=[command.current])
                message.header.stamp = _time(stamp_ns)
                self._command(message)
                self._state(_variables(CONTROLLER_STATE, stamp_ns, [*command[1:], age_ns * 1e-9]))


class Logger(_Plain):
    """Writes each message to the bag as it arrives."""

    def __init__(self, node: Node) -> None:
        parameters = declare(node, LoggerNodeParameters)
        super().__init__(node, parameters)
        self._bag = BagWriter(Path(parameters.output), compression=parameters.compression)
        self._subscriptions: dict[str, Any] = {}
        for stream in STREAMS:
            self._record(message_type(stream.layout.type_name), stream.topic, stream_qos(parameters.queue_depth))
        self._record(JointTrajectory, STAGE_TRAJECTORY, 10)
        self._record(DiagnosticArray, DIAGNOSTICS, 100)

    def _record(self, kind: Any, topic: str, qos: Any) -> None:
        name = self.node.resolve_topic_name(topic)
        self._bag.add_topic(name, f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}")

        def write(data: bytes) -> None:
            now = time.time_ns()
            self._bag.write(name, data, now, now)
            if topic == ENCODER.topic:
                self.saw(header_stamp_ns(data))

        self._subscriptions[name] = self.node.create_subscription(kind, topic, write, qos, raw=True)

    def counters(self) -> dict[str, object]:
        missing = [name for name, waiting in self._subscriptions.items() if not waiting.get_publisher_count()]
        return {**super().counters(), UNCONNECTED: " ".join(missing)}

    def close(self) -> None:
        self._bag.close()


def _time(stamp_ns: int) -> Time:
    sec, nanosec = divmod(stamp_ns, NANOSECONDS)
    return Time(sec=sec, nanosec=nanosec)


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec)


def _variables(stream: Stream, stamp_ns: int, numbers: list[float]) -> JointState:
    message = JointState(name=stream.layout.columns, position=numbers)
    message.header.stamp = _time(stamp_ns)
    return message


_NODES = {"driver": Driver, "feedforward": FeedforwardNode, "controller": Controller, "logger": Logger}


def main() -> int:
    """Run one of the nodes."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in _NODES:
        print(f"baseline: node '{name}' is unknown; allowed: {', '.join(_NODES)}", file=sys.stderr)
        return EXIT_CONFIGURATION
    return run(name, _NODES[name], executor=SingleThreadedExecutor)


if __name__ == "__main__":
    sys.exit(main())
