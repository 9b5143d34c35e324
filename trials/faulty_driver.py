"""driver, for trials: its machine, its clock and its connection for commands fail on demand.

A message on `inject` (diagnostic_msgs/DiagnosticStatus) names a fault, an empty name ends it; a message on `injected`
says when it began. The name `new_machine` requests another simulated machine, at rest in the middle.

    python -m trials.faulty_driver --ros-args …
    python -m trials.faulty_driver servo --ros-args …    # with feedforward and controller in its process
"""

import math
import sys
import time

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from straightcomp_ros.nodes import servo_node
from straightcomp_ros.nodes.driver_node import DriverComponent, make_hardware
from straightcomp_ros.parameters.node_parameters import DriverNodeParameters
from straightcomp_ros.runtime.loops import now_ns
from straightcomp_ros.runtime.managed import ManagedNode
from straightcomp_ros.runtime.runner import run_managed
from trials.faulty_machine import FaultyHardware

INJECT, INJECTED = "inject", "injected"
CLOCK_STEP, LATE_COMMANDS, NEW_MACHINE = "clock_step", "late_commands", "new_machine"
WRONG_COMMANDS = {"command_nan": math.nan, "command_infinite": -math.inf, "command_out_of_range": 5.0}
"""A for the next command."""
_STEP_NS = 1_000_000_000


class FaultyDriver(DriverComponent):
    """The driver, with faults of its machine (see :mod:`~.faulty_machine`), clock and connection."""

    def __init__(self, node: ManagedNode, parameters: DriverNodeParameters) -> None:
        self._step_ns = self._late_ns = 0
        self._parameters = parameters
        self._faulty = FaultyHardware(make_hardware(parameters), self._report)
        super().__init__(node, parameters, self._faulty, lambda: time.time_ns() + self._step_ns)
        accept = self._commands.accept
        self._wrong: float | None = None

        def accept_wrongly(stamp_ns: int, current: float, at_ns: int) -> None:
            if self._wrong is not None:
                self._report("", now_ns())
                current, self._wrong = self._wrong, None
            accept(stamp_ns, current, at_ns + self._late_ns)

        self._commands.accept = accept_wrongly
        self._injected = node.create_publisher(DiagnosticStatus, INJECTED, 10)
        node.create_subscription(DiagnosticStatus, INJECT, self._on_inject, 10)

    def _on_inject(self, message: DiagnosticStatus) -> None:
        kind = message.name
        # The middleware's clock is not stepped with ours: afterwards the reception times must match again.
        self._step_ns = _STEP_NS if kind == CLOCK_STEP else 0
        self._late_ns = 2 * self._command_timeout_ns if kind == LATE_COMMANDS else 0
        if kind in WRONG_COMMANDS:
            self._wrong = WRONG_COMMANDS[kind]
        elif kind in (CLOCK_STEP, LATE_COMMANDS):
            self._report(kind, now_ns())
        elif kind == NEW_MACHINE:
            machine = make_hardware(self._parameters)
            machine.start(now_ns())
            self._faulty.replace(machine)
        else:
            self._faulty.inject(kind)

    def _report(self, kind: str, time_ns: int) -> None:
        self._injected.publish(DiagnosticStatus(name=kind, values=[KeyValue(key="time_ns", value=str(time_ns))]))


def main() -> int:
    """Run the node."""
    driver = ("driver", DriverNodeParameters, FaultyDriver)
    return servo_node.main(driver) if "servo" in sys.argv[1:2] else run_managed([driver])


if __name__ == "__main__":
    sys.exit(main())
