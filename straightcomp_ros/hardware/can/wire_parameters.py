"""Which signals of a DBC file mean what to the driver.

Names of messages and signals are those of the file; where they lie, their scales and their limits it says itself.
"""

from dataclasses import dataclass

from straightcomp_ros.hardware.can.protection import ProtectionParameters
from straightcomp_ros.parameters.declaration import group, parameter


def _message() -> str:
    named: str = parameter("", "message in the DBC file; empty: that of 'x' or 'command'")
    return named


def _signal() -> str:
    named: str = parameter("", "signal of the message; empty: none")
    return named


def _value(default: int, meaning: str) -> int:
    raw: int = parameter(default, f"raw value that says {meaning}", "[-1, 4294967295]")
    return raw


@dataclass(frozen=True)
class SignalParameters:
    """A signal without a meaning of its values."""

    message: str = _message()
    signal: str = _signal()


@dataclass(frozen=True)
class QuantityParameters:
    """A signal with a physical value, whose unit is in the DBC file unless it is given here."""

    message: str = _message()
    signal: str = _signal()
    unit: str = parameter("", "unit of the file's physical value, e.g. mm or A; empty: as the DBC file says")
    factor: float = parameter(
        1.0, "factor on the file's physical value, e.g. -1 for a board that counts the other way", "[-1e12, 1e12]"
    )


@dataclass(frozen=True)
class AmplifierParameters:
    """The signal with the amplifier's state."""

    message: str = _message()
    signal: str = _signal()
    off_value: int = _value(1, "off; -1: any other")
    on_value: int = _value(2, "on")
    fault_value: int = _value(3, "fault; -1: the signal of 'fault' alone says so")


@dataclass(frozen=True)
class FaultParameters:
    """The signal with the board's fault code."""

    message: str = _message()
    signal: str = _signal()
    none_value: int = _value(0, "no fault")


@dataclass(frozen=True)
class SwitchParameters:
    """A signal with which the host asks for something, or the board says yes."""

    message: str = _message()
    signal: str = _signal()
    no_value: int = _value(0, "no")
    yes_value: int = _value(1, "yes")


@dataclass(frozen=True)
class HeartbeatParameters:
    """The signal with the board's own state, which it sends now and then."""

    message: str = parameter("", "message in the DBC file; empty: the board has none")
    signal: str = _signal()
    boot_up_value: int = _value(0, "that the board has just restarted")
    operational_value: int = _value(5, "that it works")


@dataclass(frozen=True)
class ProtectedMessages:
    """Protection of each message that the driver uses."""

    sample: ProtectionParameters = group(ProtectionParameters, "Protection of the CAN message of x")
    y: ProtectionParameters = group(ProtectionParameters, "Protection of the CAN message of y, if another")
    good: ProtectionParameters = group(ProtectionParameters, "Protection of the CAN message of good, if another")
    status: ProtectionParameters = group(ProtectionParameters, "Protection of the CAN message of amplifier, if another")
    current: ProtectionParameters = group(ProtectionParameters, "Protection of the CAN message of current, if another")
    command: ProtectionParameters = group(ProtectionParameters, "Protection of the CAN message of command")
    enable: ProtectionParameters = group(ProtectionParameters, "Protection of the CAN message of enable, if another")
    reset: ProtectionParameters = group(ProtectionParameters, "Protection of the CAN message of reset, if another")
    echo: ProtectionParameters = group(ProtectionParameters, "Protection of the CAN message of echo, if another")


@dataclass(frozen=True)
class WireParameters:
    """The meaning of a board's signals."""

    x: QuantityParameters = group(QuantityParameters, "Position of the stage on CAN")
    y: QuantityParameters = group(QuantityParameters, "Position of the platform on CAN")
    current: QuantityParameters = group(QuantityParameters, "Measured coil current on CAN")
    counter: SignalParameters = group(SignalParameters, "Number of the sample on CAN")
    good: SwitchParameters = group(SwitchParameters, '"Both encoder readings are good" on CAN')
    amplifier: AmplifierParameters = group(AmplifierParameters, "State of the amplifier on CAN")
    fault: FaultParameters = group(FaultParameters, "Board's fault code on CAN")
    heartbeat: HeartbeatParameters = group(HeartbeatParameters, "Board's heartbeat on CAN")
    command: QuantityParameters = group(QuantityParameters, "Commanded control current on CAN")
    enable: SwitchParameters = group(SwitchParameters, '"Amplifier on" on CAN')
    reset: SwitchParameters = group(SwitchParameters, '"Clear the fault" on CAN')
    echo: SignalParameters = group(SignalParameters, "Number of the answered sample on CAN")
    protection: ProtectedMessages = group(ProtectedMessages)
