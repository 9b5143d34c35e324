"""cell: a reference client of the graph, as a cell controller would be one.

It brings the nodes up, switches the amplifier on, homes, runs the strokes, watches, reacts to faults, and reports.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator, Iterator
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.cell.cycle import IN_THE_LOOP
from straightcomp_ros.configuration.node_parameters import CellNodeParameters
from straightcomp_ros.contract import (
    ALWAYS_PUBLISHED,
    DIAGNOSTICS,
    POSITION,
    SAFETY_STATE,
    STAGE_TRAJECTORY,
    UNCONNECTED,
)
from straightcomp_ros.model.stage import cycles
from straightcomp_ros.runtime.declare import declare
from straightcomp_ros.runtime.heartbeats import Heartbeats
from straightcomp_ros.runtime.runner import EXIT_FAILURE, run
from straightcomp_ros.runtime.safety_panel import LATCHED, SafetyState
from straightcomp_ros.runtime.stage_trajectory import message_from_waypoints
from straightcomp_ros.runtime.streams import subscribe
from straightcomp_ros.safety.state_machine import Condition
from straightcomp_ros.timing.node_timing import LOST, blamed, held_up, reporting_node

_TICK_S = 0.05
_SETTLE_S = 1.5
"""A node that has just come up allocates and connects for about a second more, and loses messages meanwhile."""
_HOME_S = 1.0
"""Time that the reference takes to the middle, or back to the map, and the platform to follow."""
_FIRST_HEARTBEAT_S = 2.0
_REPORTED_S = 1.5
"""Each node's next diagnostics have come by then."""
_STATE_KNOWN_S = 0.3
"""Three heartbeats: each says its node's state."""
_BRING_UP = {Transition.TRANSITION_CONFIGURE: "unconfigured", Transition.TRANSITION_ACTIVATE: "inactive"}
"""Transitions in their order, each with the state that it leaves."""


class CycleFailed(Exception):
    """The cycle cannot go on; the message says why."""


class CellNode:
    """One cycle, written as it happens: see :meth:`_cycle`. Each ``yield`` waits for the next tick."""

    def __init__(self, node: Node) -> None:
        self._parameters = declare(node, CellNodeParameters)
        self.node, self.done, self.realtime, self.loop = node, Future(), self._parameters.realtime, None
        self._waypoints = cycles(self._parameters.motion, self._parameters.strokes)
        self._first_stamp_ns = self._stamp_ns = 0
        self._safety = SafetyState()
        self._last_sample = 0.0
        self._reports: dict[str, dict[str, str]] = {}
        self._faults = 0
        names = self._parameters.nodes.split()
        self._heartbeats = Heartbeats(node, names, self._parameters.heartbeat_timeout)
        self._change_state = {name: node.create_client(ChangeState, f"{name}/change_state") for name in names}
        self._enable = node.create_client(SetBool, "driver/enable")
        self._reset = node.create_client(Trigger, "driver/reset_fault")
        self._center = node.create_client(SetBool, "feedforward/center")
        self._trajectory = node.create_publisher(JointTrajectory, STAGE_TRAJECTORY, 10)
        subscribe(node, POSITION, self._on_position)
        node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, 10)
        node.create_subscription(DiagnosticStatus, SAFETY_STATE, self._on_safety_state, LATCHED)
        self._steps = self._explained(self._cycle())
        node.create_timer(_TICK_S, self._tick)

    def _explained(self, cycle: Iterator[None]) -> Iterator[None]:
        """The cycle; where it fails, the amplifier goes off, and what held the nodes up meanwhile is said too."""
        try:
            yield from cycle
        except CycleFailed as failure:
            if self._enable.service_is_ready():
                self._enable.call_async(SetBool.Request(data=False))
            before = dict(self._reports)
            yield from self._for(_REPORTED_S)
            latest = {
                node: held_up([*([before[node]] if node in before else []), self._reports[node]])
                for node in IN_THE_LOOP
                if node in self._reports
            }
            why = blamed(latest)
            raise CycleFailed(f"{failure} ({why})" if why else str(failure)) from failure

    def _cycle(self) -> Iterator[None]:
        log = self.node.get_logger()
        yield from self._until(
            lambda: not self._missing_nodes(), lambda: f"missing: {', '.join(self._missing_nodes())}"
        )
        yield from self._bring_up()
        yield from self._until(
            lambda: self._trajectory.get_subscription_count() > 0, lambda: "nobody takes the stage's trajectory"
        )
        yield from self._until(self._enable.service_is_ready, lambda: "the driver's service 'enable' is not there")
        yield from self._until(
            lambda: not self._unrecorded_topics(), lambda: f"not recorded: {', '.join(self._unrecorded_topics())}"
        )
        yield from self._for(_SETTLE_S)
        yield from self._switch_on()
        # In lockstep there is no time before the motion.
        if self._parameters.home and self._stamp_ns:
            yield from self._home()
        first_ns = self._stamp_ns
        self._trajectory.publish(message_from_waypoints(self._waypoints))
        log.info(f"stage moves: {self._waypoints[-1].time_ns * 1e-9:.1f} s")
        yield from self._follow_motion(first_ns)
        yield from self._switch(False)
        lost = self._reports.get("driver", {}).get(LOST, "?")
        log.info(f"cycle complete: {self._parameters.strokes} strokes, {self._faults} faults, {lost} samples lost")

    def _bring_up(self) -> Iterator[None]:
        """Configure and activate the nodes that have not done so by themselves."""
        # A node that is no lifecycle node (a player) has no heartbeat.
        deadline = time.monotonic() + _FIRST_HEARTBEAT_S
        while self._heartbeats.silent() and time.monotonic() < deadline:
            yield
        for transition, state in _BRING_UP.items():
            for name, client in self._change_state.items():
                if self._heartbeats.states[name] == state:
                    answer = yield from self._ask(client, ChangeState.Request(transition=Transition(id=transition)))
                    if not answer.success:
                        raise CycleFailed(f"{name} did not leave the state '{state}'; its log says why")
            yield from self._for(_STATE_KNOWN_S)

    def _home(self) -> Iterator[None]:
        for middle in (True, False):
            answer = yield from self._ask(self._center, SetBool.Request(data=middle))
            if not answer.success:
                raise CycleFailed(f"homing: {answer.message}")
            yield from self._for(_HOME_S)

    def _switch_on(self) -> Iterator[None]:
        deadline = time.monotonic() + self._parameters.start_timeout
        while True:
            answer = yield from self._switch(True)
            if answer.success:
                # The driver's answer may come before its state. Should that be a fault already, the motion sees it.
                yield from self._until(
                    lambda: self._safety.condition is not Condition.OFF, lambda: "the driver does not say that it is on"
                )
                return
            if time.monotonic() > deadline:
                raise CycleFailed(f"the driver refuses to enable: {answer.message}")
            yield

    def _switch(self, on: bool) -> Generator[None, None, SetBool.Response]:
        return (yield from self._ask(self._enable, SetBool.Request(data=on)))

    def _ask(self, client: Any, request: Any) -> Generator[None, None, Any]:
        yield from self._until(client.service_is_ready, lambda: f"service '{client.srv_name}' is not there")
        future = client.call_async(request)
        yield from self._until(future.done, lambda: f"no answer to '{client.srv_name}'")
        return future.result()

    def _follow_motion(self, first_ns: int) -> Iterator[None]:
        duration_ns = self._waypoints[-1].time_ns
        self._last_sample = time.monotonic()
        while True:
            # In lockstep there is no sample before the trajectory.
            first_ns = first_ns or self._first_stamp_ns
            fraction = (self._stamp_ns - first_ns) / duration_ns
            if self._parameters.progress:
                print(f"progress {min(fraction, 1.0):.3f}", flush=True)
            if fraction > 0.9995:
                return
            silence = time.monotonic() - self._last_sample
            if silence > self._parameters.sample_timeout:
                raise CycleFailed(f"no sample for {silence:.1f} s")
            lost = self._heartbeats.lost()
            if lost:
                raise CycleFailed(f"no heartbeat of: {', '.join(lost)}")
            if not self._safety.amplifier_on:
                yield from self._recover()
            yield

    def _recover(self) -> Iterator[None]:
        """Switch on again after a fault, if that is still allowed."""
        self._faults += 1
        if self._faults > self._parameters.recoveries:
            raise CycleFailed(f"amplifier off in mid-cycle: {self._reason}")
        self.node.get_logger().warning(f"fault {self._faults}: {self._reason}; switching on again")
        yield from self._ask(self._reset, Trigger.Request())
        yield from self._until(lambda: not self._safety.fault, lambda: f"the fault remains: {self._safety.fault}")
        yield from self._switch_on()

    @property
    def _reason(self) -> str:
        return self._safety.fault or "somebody has switched it off"

    def _missing_nodes(self) -> list[str]:
        present = self.node.get_node_names_and_namespaces()
        here = self.node.get_namespace()
        return [name for name in self._parameters.nodes.split() if (name, here) not in present]

    def _unrecorded_topics(self) -> list[str]:
        """Streams that the logger, if there is to be one, is not connected to: it would miss their beginning."""
        if "logger" not in self._parameters.nodes.split():
            return []
        unconnected = self._reports.get("logger", {}).get(UNCONNECTED)
        topics = [self.node.resolve_topic_name(stream.topic) for stream in ALWAYS_PUBLISHED]
        return topics if unconnected is None else [topic for topic in topics if topic in unconnected.split()]

    def _until(self, condition: Callable[[], bool], otherwise: Callable[[], str]) -> Iterator[None]:
        deadline = time.monotonic() + self._parameters.start_timeout
        while not condition():
            if time.monotonic() > deadline:
                raise CycleFailed(otherwise())
            yield

    def _for(self, seconds: float) -> Iterator[None]:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            yield

    def _tick(self) -> None:
        if self.done.done():
            return
        try:
            next(self._steps)
        except StopIteration:
            self.done.set_result(0)
        except CycleFailed as failure:
            self.node.get_logger().error(f"cycle failed: {failure}")
            self.done.set_result(EXIT_FAILURE)

    def _on_position(self, stamp_ns: int, _: list[float]) -> None:
        self._first_stamp_ns = self._first_stamp_ns or stamp_ns
        self._stamp_ns = stamp_ns
        self._last_sample = time.monotonic()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if node := reporting_node(status.name, self.node.get_namespace()):
                self._reports[node] = {value.key: value.value for value in status.values}

    def _on_safety_state(self, message: DiagnosticStatus) -> None:
        self._safety = SafetyState.of(message)

    def close(self) -> None:
        """Nothing to make safe: the driver switches off when commands cease."""


def main() -> int:
    """Entry point of `ros2 run straightcomp_ros cell_node`."""
    return run("cell", CellNode)


if __name__ == "__main__":
    sys.exit(main())
