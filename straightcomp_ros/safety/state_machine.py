"""The safety state machine: the only place that switches the amplifier.

OFF ──enable──▶ ON ──disable──▶ OFF         OFF, ON ──trip──▶ FAULT ──reset──▶ OFF
"""

import enum
from collections.abc import Mapping
from typing import NamedTuple

from straightcomp_ros.hardware.interface import Hardware, HardwareError
from straightcomp_ros.safety.faults import Fault


class Condition(enum.Enum):
    OFF = "off"
    ON = "on"
    FAULT = "fault"


class Event(enum.Enum):
    """What causes a transition."""

    ENABLE = "enable"
    DISABLE = "disable"
    TRIP = "trip"
    RESET = "reset"


TRANSITIONS: Mapping[tuple[Condition, Event], Condition] = {
    (Condition.OFF, Event.ENABLE): Condition.ON,
    (Condition.OFF, Event.DISABLE): Condition.OFF,
    (Condition.OFF, Event.TRIP): Condition.FAULT,
    (Condition.OFF, Event.RESET): Condition.OFF,
    (Condition.ON, Event.ENABLE): Condition.ON,
    (Condition.ON, Event.DISABLE): Condition.OFF,
    (Condition.ON, Event.TRIP): Condition.FAULT,
    (Condition.ON, Event.RESET): Condition.ON,
    (Condition.FAULT, Event.DISABLE): Condition.FAULT,
    (Condition.FAULT, Event.TRIP): Condition.FAULT,
    (Condition.FAULT, Event.RESET): Condition.OFF,
}
"""All transitions. There is none for (FAULT, ENABLE): enabling does not clear a fault."""


class Latched(NamedTuple):
    """A latched fault, its reason as text, and its time in ns since the epoch."""

    fault: Fault
    reason: str
    time_ns: int


class SafetyMachine:
    """Switches the amplifier of ``hardware`` by the transitions above."""

    def __init__(self, hardware: Hardware) -> None:
        self._hardware = hardware
        self.condition = Condition.OFF
        self.fault: Latched | None = None
        """The first fault since the last reset; those after it are its consequences."""
        self.trips = 0
        """Number of all faults, with those after the first."""

    def enable(self) -> str:
        """Switch the amplifier on; returns the reason of a refusal, or an empty text."""
        if (self.condition, Event.ENABLE) not in TRANSITIONS:
            return f"a fault is latched: {self.reason}; call reset_fault"
        try:
            self._hardware.enable()
        except HardwareError as error:
            return str(error)
        self._go(Event.ENABLE)
        return ""

    def disable(self) -> None:
        self._hardware.disable()
        self._go(Event.DISABLE)

    def trip(self, fault: Fault, reason: str, time_ns: int) -> None:
        """Switch the amplifier off until :meth:`reset`."""
        self.trips += 1
        if self.fault is None:
            # Once: a board gets a frame with each, and a foreign publisher can cause thousands of faults in a second.
            self._hardware.disable()
            self.fault = Latched(fault, reason, time_ns)
            self._go(Event.TRIP)

    def reset(self) -> None:
        """Clear the fault; the amplifier stays as it is."""
        self._hardware.reset_fault()
        self.fault = None
        self._go(Event.RESET)

    @property
    def reason(self) -> str:
        """The fault as text; empty without one."""
        return f"{self.fault.fault.label}: {self.fault.reason}" if self.fault is not None else ""

    def _go(self, event: Event) -> None:
        self.condition = TRANSITIONS[self.condition, event]
