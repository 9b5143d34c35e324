"""The frames of one identifier: what they say, and the functions that pack and unpack them."""

from collections.abc import Callable

from straightcomp_ros.hardware.can.frames import Command, Report
from straightcomp_ros.hardware.can.message_code import Signals

_HEARTBEAT_PERIOD = 0.05
"""s, where the DBC file does not say it."""


class ReportFrames:
    """The frames of one identifier that a board sends; ``unpack(payload)`` raises FrameError.

    ``every`` is the number of samples from one frame to the next; ``alive_modulus`` that of the count of the frames, 1
    without; ``spans`` has least and largest values in SI units by field.
    """

    def __init__(self, signals: Signals, no_fault: int) -> None:
        self.signals, self.identifier, self.fd = signals, signals.identifier, signals.fd
        self.size = signals.message.length
        self.unpack: Callable[[bytes], Report] = signals.unpacking_report(no_fault)
        self._packings = signals.packings(Report._fields)
        self.every, self.alive_modulus = 1, signals.counts("alive") or 1
        self.spans = {field: signals.span(field) for field in signals.factors}

    def pack(self, report: Report, turn: int) -> bytes:
        """Payload of the ``turn``-th frame: the pages of a multiplexed message take turns.

        Raises:
            ValueError: a value does not fit its signal.
        """
        return self._packings[turn % len(self._packings)](report)


class CommandFrames:
    """The frames of one identifier that the host sends; ``unpack(payload)`` raises FrameError, ``pack(command)``
    ValueError. ``alive_modulus`` is that of the count of the frames, 1 without; ``span`` has least and largest control
    current in A."""

    def __init__(self, signals: Signals) -> None:
        self.signals, self.identifier, self.fd = signals, signals.identifier, signals.fd
        self.size = signals.message.length
        self.unpack: Callable[[bytes], Command] = signals.unpacking_command()
        (self.pack,) = signals.packings(Command._fields)
        self.alive_modulus = signals.counts("alive") or 1
        self.span, self._half = (0.0, 0.0), 0.0
        if "current" in signals.signals:
            self.span, self._half = signals.span("current"), 0.5 * signals.step("current")

    def fits(self, current: float) -> bool:
        """Whether a control current in A can be sent; NaN cannot."""
        return self.span[0] - self._half < current < self.span[1] + self._half


class HeartbeatFrames:
    """The heartbeat of a board."""

    def __init__(self, signals: Signals, boot_up: int, operational: int) -> None:
        self.signals, self.identifier, self.fd = signals, signals.identifier, signals.fd
        self.boot_up, self.operational = boot_up, operational
        self.period = (signals.message.cycle_time or 0) * 1e-3 or _HEARTBEAT_PERIOD
        self._unpacking, (self._packing,) = signals.unpacking(("state",)), signals.packings(("state",))

    def unpack(self, payload: bytes) -> int:
        """State in a heartbeat; raises FrameError."""
        return int(self._unpacking(payload)[0])

    def pack(self, state: int) -> bytes:
        """Payload of a heartbeat with this state."""
        return self._packing((state,))
