"""controller: encoder samples and their references in, control current out."""

from __future__ import annotations

import sys

from rclpy.node import Node
from rclpy.task import Future

from straightcomp_ros.configuration import ControllerNodeParameters
from straightcomp_ros.contract import COMMAND, CONTROLLER_STATE, ENCODER, REFERENCE
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.control.pairing import Pairing
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.nodes.declare import declare
from straightcomp_ros.nodes.diagnostics import Diagnostics
from straightcomp_ros.nodes.runner import run
from straightcomp_ros.nodes.streams import publisher, subscribe


class ControllerNode:
    """Pairs each sample with its reference and steps the law, on the timer or on arrival.

    When a cycle finds several new samples the law steps through all of them in order: its velocity
    estimate and its integral need every sample, and a replay of the bag gives the same commands.
    """

    def __init__(self, node: Node) -> None:
        parameters = declare(node, ControllerNodeParameters)
        self.node, self.done, self.realtime = node, Future(), parameters.realtime
        self._servo = Servo(make_law(parameters.control, 1.0 / parameters.rate))
        self._pairing = Pairing()
        self._publish_command = publisher(node, COMMAND)
        self._publish_state = publisher(node, CONTROLLER_STATE)
        self._commands = self._refused = self._idle_cycles = 0
        self._on_arrival = parameters.trigger == "sample"
        subscribe(node, ENCODER, self._on_sample)
        subscribe(node, REFERENCE, self._on_reference)
        if not self._on_arrival:
            node.create_timer(1.0 / parameters.rate, self._cycle)
        Diagnostics(node, self._counters)

    def _on_sample(self, stamp_ns: int, numbers: list[float]) -> None:
        self._pairing.add_sample(stamp_ns, numbers)
        if self._on_arrival:
            self._cycle()

    def _on_reference(self, stamp_ns: int, numbers: list[float]) -> None:
        self._pairing.add_reference(stamp_ns, numbers)
        if self._on_arrival:
            self._cycle()

    def _cycle(self) -> None:
        ready = self._pairing.ready
        if not ready:
            self._idle_cycles += 1
        while ready:
            stamp_ns, sample, reference = ready.popleft()
            command = self._servo.step(stamp_ns, sample[1], sample[3], reference)
            if command is None:
                self._refused += 1
                continue
            self._publish_command(stamp_ns, command.current)
            self._publish_state(stamp_ns, *command[1:])
            self._commands += 1

    def _counters(self) -> dict[str, object]:
        return {
            "commands": self._commands,
            "refused_samples": self._refused,
            "unmatched_samples": self._pairing.unmatched,
            "idle_cycles": self._idle_cycles,
        }

    def close(self) -> None:
        """Nothing to make safe: the driver switches off when no command comes."""


def main() -> int:
    """Entry point of `ros2 run straightcomp_ros controller_node`."""
    return run("controller", ControllerNode)


if __name__ == "__main__":
    sys.exit(main())
