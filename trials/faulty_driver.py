"""driver, for trials: its machine, its clock and its connection for commands fail on demand.

A message on `inject` (diagnostic_msgs/DiagnosticStatus) names one of :data:`FAULTS`, an empty name ends it; a message
on `injected` says when it began. The name `new machine` requests another simulated machine, at rest in the middle.

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
from straightcomp_ros.safety.faults import Fault
from trials import faulty_machine

INJECT, INJECTED = "inject", "injected"
NEW_MACHINE, _CLOCK_JUMP, _LATE = "new machine", "clock jump", "late commands"
_COMMANDS = {
    "command NaN": (Fault.COMMAND_NOT_FINITE, math.nan),
    "command infinite": (Fault.COMMAND_NOT_FINITE, -math.inf),
    "command out of range": (Fault.COMMAND_OUT_OF_RANGE, 5.0),
}
"""A for the next command."""
FAULTS = {name: fault for name, (fault, _) in faulty_machine.FAULTS.items()}
FAULTS |= {_CLOCK_JUMP: Fault.CLOCK_JUMP, **{name: fault for name, (fault, _) in _COMMANDS.items()}}
FAULTS |= {_LATE: Fault.COMMAND_TIMEOUT}
"""What is found of each fault that can be injected, by its name."""
_STEP_NS = 1_000_000_000


class FaultyDriver(DriverComponent):
    """The driver, with faults of its machine (see :mod:`~.faulty_machine`), clock and connection."""

    def __init__(self, node: ManagedNode, parameters: DriverNodeParameters) -> None:
        self._parameters, self._name = parameters, ""
        self._faulty = faulty_machine.FaultyHardware(make_hardware(parameters), self._report)
        # The middleware's clock is not stepped with ours: afterwards the reception times must match again.
        super().__init__(
            node, parameters, self._faulty, lambda: time.time_ns() + _STEP_NS * (self._name == _CLOCK_JUMP)
        )
        accept = self._commands.accept

        def accept_wrongly(stamp_ns: int, current: float, at_ns: int) -> None:
            if self._name in _COMMANDS:
                self._report(self._name, now_ns())
                (_, current), self._name = _COMMANDS[self._name], ""
            accept(stamp_ns, current, at_ns + 2 * self._command_timeout_ns * (self._name == _LATE))

        self._commands.accept = accept_wrongly
        self._injected = node.create_publisher(DiagnosticStatus, INJECTED, 10)
        node.create_subscription(DiagnosticStatus, INJECT, self._on_inject, 10)

    def _on_inject(self, message: DiagnosticStatus) -> None:
        self._name = message.name
        self._faulty.inject(self._name if self._name in faulty_machine.FAULTS else "")
        if self._name in (_CLOCK_JUMP, _LATE):
            self._report(self._name, now_ns())
        elif self._name == NEW_MACHINE:
            machine = make_hardware(self._parameters)
            machine.start(now_ns())
            self._faulty.replace(machine)

    def _report(self, name: str, time_ns: int) -> None:
        self._injected.publish(DiagnosticStatus(name=name, values=[KeyValue(key="time_ns", value=str(time_ns))]))


def main() -> int:
    """Run the node."""
    driver = ("driver", DriverNodeParameters, FaultyDriver)
    return servo_node.main(driver) if "servo" in sys.argv[1:2] else run_managed([driver])


if __name__ == "__main__":
    sys.exit(main())
