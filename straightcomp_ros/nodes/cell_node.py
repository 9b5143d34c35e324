"""cell: a reference client of the graph: waits for the nodes, switches on, runs the stage forward and back."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator, Iterator

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.configuration import CellNodeParameters
from straightcomp_ros.contract import ALWAYS_PUBLISHED, DIAGNOSTICS, DRIVER_STATE, STAGE_TRAJECTORY, UNCONNECTED
from straightcomp_ros.model.stage import forward_and_back
from straightcomp_ros.nodes.declare import declare
from straightcomp_ros.nodes.runner import EXIT_FAILURE, run
from straightcomp_ros.nodes.stage_trajectory import message_from_waypoints
from straightcomp_ros.nodes.streams import subscribe

_TICK_S = 0.05
_ENABLED = DRIVER_STATE.layout.columns.index("enabled")
_SETTLE_S = 1.5
"""A node that has just come up allocates and connects for about a second more, and loses messages meanwhile."""
_REASON_S = 1.5
"""Time that the driver's diagnostics get to tell why the amplifier is off."""


class CycleFailed(Exception):
    """The cycle cannot go on; the message says why."""


class CellNode:
    """One cycle, written as it happens: see :meth:`_cycle`. Each ``yield`` waits for the next tick."""

    def __init__(self, node: Node) -> None:
        self._parameters = declare(node, CellNodeParameters)
        self.node, self.done, self.realtime, self.loop = node, Future(), self._parameters.realtime, None
        self._waypoints = forward_and_back(self._parameters.motion)
        self._first_stamp_ns = self._stamp_ns = 0
        self._amplifier_on = False
        self._last_sample = 0.0
        self._reports: dict[str, dict[str, str]] = {}
        self._errors: dict[str, str] = {}
        self._enable = node.create_client(SetBool, "driver/enable")
        self._trajectory = node.create_publisher(JointTrajectory, STAGE_TRAJECTORY, 10)
        # The driver's record of each sample comes in bursts: it wakes this process an eighth as often as the encoder.
        subscribe(node, DRIVER_STATE, self._on_driver_state)
        node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, 10)
        self._steps = self._cycle()
        node.create_timer(_TICK_S, self._tick)

    def _cycle(self) -> Iterator[None]:
        log = self.node.get_logger()
        yield from self._until(
            lambda: not self._missing_nodes(), lambda: f"missing: {', '.join(self._missing_nodes())}"
        )
        yield from self._until(
            lambda: self._trajectory.get_subscription_count() > 0, lambda: "nobody takes the stage's trajectory"
        )
        yield from self._until(self._enable.service_is_ready, lambda: "the driver's service 'enable' is not there")
        yield from self._until(
            lambda: not self._unrecorded_topics(), lambda: f"not recorded: {', '.join(self._unrecorded_topics())}"
        )
        yield from self._for(_SETTLE_S)
        yield from self._switch_on()
        first_ns = self._stamp_ns
        self._trajectory.publish(message_from_waypoints(self._waypoints))
        log.info(f"stage moves: {self._waypoints[-1].time_ns * 1e-9:.1f} s")
        yield from self._follow_motion(first_ns)
        yield from self._switch(False)
        log.info("cycle complete")

    def _switch_on(self) -> Iterator[None]:
        deadline = time.monotonic() + self._parameters.start_timeout
        while True:
            answer = yield from self._switch(True)
            if answer.success:
                return
            if time.monotonic() > deadline:
                raise CycleFailed(f"the driver refuses to enable: {answer.message}")
            yield

    def _switch(self, on: bool) -> Generator[None, None, SetBool.Response]:
        future = self._enable.call_async(SetBool.Request(data=on))
        yield from self._until(future.done, lambda: "the driver does not answer 'enable'")
        return future.result()

    def _follow_motion(self, first_ns: int) -> Iterator[None]:
        duration_ns = self._waypoints[-1].time_ns
        self._last_sample = time.monotonic()
        off_since = None
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
            off_since = None if self._amplifier_on else off_since or time.monotonic()
            # The reason comes with the driver's next diagnostics, within a second.
            if off_since and time.monotonic() - off_since > _REASON_S:
                raise CycleFailed(f"amplifier off in mid-cycle: {self._errors or 'no reason given'}")
            yield

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
            if self._enable.service_is_ready():
                self._enable.call_async(SetBool.Request(data=False))
            self.done.set_result(EXIT_FAILURE)

    def _on_driver_state(self, stamp_ns: int, numbers: list[float]) -> None:
        self._first_stamp_ns = self._first_stamp_ns or stamp_ns
        self._stamp_ns = stamp_ns
        self._amplifier_on = bool(numbers[_ENABLED])
        self._last_sample = time.monotonic()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            node = status.name.rsplit("/", 1)[-1]
            self._reports[node] = {value.key: value.value for value in status.values}
            if status.level == DiagnosticStatus.ERROR:
                self._errors[node] = status.message

    def close(self) -> None:
        """Nothing to make safe: the driver switches off when commands cease."""


def main() -> int:
    """Entry point of `ros2 run straightcomp_ros cell_node`."""
    return run("cell", CellNode)


if __name__ == "__main__":
    sys.exit(main())
