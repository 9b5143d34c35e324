"""The safety state machine: the only place that switches the amplifier.

OFF ──enable──▶ ON ──disable──▶ OFF         OFF, ON ──trip──▶ FAULT ──reset──▶ OFF

Every other event leaves the condition as it is; enabling does not clear a fault, and a reset does not switch off.
"""

from typing import NamedTuple

from straightcomp_ros.hardware.interface import Hardware, HardwareError, State
from straightcomp_ros.safety.faults import Fault


class Latched(NamedTuple):
    """A latched fault, its reason as text, and its time in ns since the epoch."""

    fault: Fault
    reason: str
    time_ns: int


class SafetyMachine:
    """Switches the amplifier of ``hardware`` by the transitions above."""

    def __init__(self, hardware: Hardware) -> None:
        self._hardware = hardware
        self._on = False
        self.fault: Latched | None = None
        """The first fault since the last reset; those after it are its consequences."""
        self._of_hardware = False
        """Whether that fault is the hardware's own."""
        self.trips = 0
        """Number of all faults, with those after the first."""

    @property
    def condition(self) -> State:
        if self.fault is not None:
            return State.FAULT
        return State.ON if self._on else State.OFF

    def enable(self) -> str:
        """Switch the amplifier on; returns the reason of a refusal, or an empty text."""
        if self.fault is not None:
            return f"a fault is latched: {self.reason}; call reset_fault"
        try:
            self._hardware.enable()
        except HardwareError as error:
            return str(error)
        self._on = True
        return ""

    def disable(self) -> None:
        self._hardware.disable()
        self._on = False

    def trip(self, fault: Fault, reason: str, time_ns: int) -> None:
        """Switch the amplifier off until :meth:`reset`."""
        self.trips += 1
        if self.fault is None:
            # Once: a board gets a frame with each, and a foreign publisher can cause thousands of faults in a second.
            self.disable()
            self.fault = Latched(fault, reason, time_ns)

    def follow(self, time_ns: int) -> None:
        """Latch the hardware's own fault, and take over the words that it gets later."""
        found = self._hardware.fault
        if found is None:
            return
        if self.fault is None:
            self.trip(*found, time_ns)
            self._of_hardware = True
        elif self._of_hardware:
            self.fault = Latched(*found, self.fault.time_ns)

    def reset(self) -> None:
        """Clear the fault; the amplifier stays as it is."""
        self._hardware.reset_fault()
        self.fault, self._of_hardware = None, False

    @property
    def reason(self) -> str:
        """The fault as text; empty without one."""
        return f"{self.fault.fault.label}: {self.fault.reason}" if self.fault is not None else ""
