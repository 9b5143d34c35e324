"""Parameters of a board on CAN: its bus, its DBC file, and which signals of that file mean what to the driver.

Names of messages and signals are those of the file; where they lie, their scales and their limits it says itself.
"""

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from straightcomp_ros.hardware.interface import SILENT_SAMPLES
from straightcomp_ros.parameters.declaration import RefusedParameter, group, parameter, to_mapping

if TYPE_CHECKING:
    from straightcomp_ros.hardware.can.board_dbc import Wire

READINGS = ("x", "y", "good")
"""What a sample is not complete without, as far as the board has it."""
SHIPPED_DBC = "config/straightcomp.dbc"
_LOG_ENDINGS = (".log", ".blf")


def _value(default: int, meaning: str, least: int = -1) -> int:
    raw: int = parameter(default, f"raw value that says {meaning}", f"[{least}, 4294967295]")
    return raw


@dataclass(frozen=True)
class SignalParameters:
    """A signal; those below say what its values mean."""

    message: str = parameter("", "message in the DBC file; empty: that of 'x' or 'command'")
    signal: str = parameter("", "signal of the message; empty: none")


@dataclass(frozen=True)
class QuantityParameters(SignalParameters):
    """A signal with a physical value, whose unit is in the DBC file unless it is given here."""

    unit: str = parameter("", "unit of the file's physical value, e.g. mm or A; empty: as the DBC file says")
    factor: float = parameter(
        1.0, "factor on the file's physical value, e.g. -1 for a board that counts the other way", "[-1e12, 1e12]"
    )


@dataclass(frozen=True)
class AmplifierParameters(SignalParameters):
    """The signal with the amplifier's state."""

    off_value: int = _value(1, "off; -1: any other")
    on_value: int = _value(2, "on", 0)
    fault_value: int = _value(3, "fault; -1: the signal of 'fault' alone says so")


@dataclass(frozen=True)
class FaultParameters(SignalParameters):
    """The signal with the board's fault code."""

    none_value: int = _value(0, "no fault")


@dataclass(frozen=True)
class SwitchParameters(SignalParameters):
    """A signal with which the host asks for something, or the board says yes."""

    no_value: int = _value(0, "no")
    yes_value: int = _value(1, "yes")


@dataclass(frozen=True)
class HeartbeatParameters(SignalParameters):
    """The signal with the board's own state, which it sends now and then."""

    message: str = parameter("", "message in the DBC file; empty: the board has none")
    boot_up_value: int = _value(0, "that the board has just restarted")
    operational_value: int = _value(5, "that it works")


@dataclass(frozen=True)
class ProtectionParameters:
    """How the frames of one message are protected."""

    profile: str = parameter(
        "none",
        "CRC: AUTOSAR E2E profile 1, 2 or 5, SAE J1850, or none",
        choices=("none", "e2e_1", "e2e_2", "e2e_5", "j1850"),
    )
    crc: str = parameter("", "signal with the CRC")
    alive: str = parameter("", "signal that counts these frames; empty: none")
    data_id: str = parameter(
        "",
        "data id of profile 1 or 5, e.g. 0x123, or the 16 of profile 2 separated by blanks; empty: the CAN identifier",
    )


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
    referenced: SwitchParameters = group(SwitchParameters, '"x is counted from its reference" on CAN')
    x_wraps: bool = parameter(
        False, "On CAN x goes on at the other end of its signal's range, whose width is that of the encoder's counter"
    )
    heartbeat: HeartbeatParameters = group(HeartbeatParameters, "Board's heartbeat on CAN")
    command: QuantityParameters = group(QuantityParameters, "Commanded control current on CAN")
    enable: SwitchParameters = group(SwitchParameters, '"Amplifier on" on CAN')
    reset: SwitchParameters = group(SwitchParameters, '"Clear the fault" on CAN')
    echo: SignalParameters = group(SignalParameters, "Number of the answered sample on CAN")
    protection: ProtectedMessages = group(ProtectedMessages)

    @property
    def given(self) -> dict[str, Any]:
        """What differs from the defaults, by its name."""
        usual = to_mapping(WireParameters())
        return {name: value for name, value in to_mapping(self).items() if value != usual[name]}

    @property
    def readback_lag(self) -> int:
        """Samples by which the measured current is older than the readings that it comes with.

        A current in a message of its own comes after the sample that it belongs to.
        """
        named = (getattr(self, role) for role in READINGS)
        of_sample = {one.message or self.x.message for one in named if one.signal}
        apart = (self.current.message or self.x.message) not in of_sample
        return 1 if self.current.signal and apart else 0


@dataclass(frozen=True)
class CanParameters:
    """An encoder and DSP board on a CAN bus, through any interface of python-can."""

    interface: str = parameter("socketcan", "Interface of python-can, e.g. socketcan, pcan, kvaser")
    channel: str = parameter("can0", "Channel of the interface, as python-can names it")
    bitrate: int = parameter(1_000_000, "Bit rate; socketcan uses the system's", "[10000, 1e6] bit/s")
    fd: bool = parameter(True, "The bus is one for CAN FD")
    data_bitrate: int = parameter(5_000_000, "Bit rate of the data phase of CAN FD", "[10000, 8e6] bit/s")
    options: str = parameter("", "Further arguments for python-can, as NAME=VALUE separated by blanks")
    dbc: str = parameter("", "DBC file of the board; empty: config/straightcomp.dbc, for which 'wire' must be left out")
    wire: WireParameters = group(WireParameters)
    node: int = parameter(1, "Node id of the board; the identifiers in the DBC file are those of node 1", "[1, 127]")
    command_timeout: float = parameter(
        0.005,
        "Age of a command from which it is not sent any more; four times as long without one, three samples at least, "
        "latches a fault while the amplifier is on",
        "(0, 1] s",
    )
    sample_timeout: float = parameter(
        0.005,
        "Time without a sample, three samples at least, that latches a fault while the amplifier is on",
        "(0, 1] s",
    )
    heartbeat_timeout: float = parameter(
        0.15,
        "Time without the board's heartbeat, or without the amplifier's state where that has frames of its own, that "
        "latches a fault",
        "(0, 10] s",
    )
    answer_timeout: float = parameter(
        0.1, "Longest wait for the board to switch on or off, or to clear a fault", "(0, 10] s"
    )
    strike_limit: int = parameter(
        16, "Error counter that latches a fault: a bad frame adds 4, a good one subtracts 1", "[4, 1000]"
    )
    y_speed: float = parameter(0.5, "A change of y faster than this is a wrong frame", "(0, 100] m/s")
    sample_memory: int = parameter(256, "Samples kept for a late driver", "[1, 100000]")
    simulated_stage: bool = parameter(
        False, "The board is the emulator: send it stage trajectories, take the simulation's truth on CAN FD"
    )
    firmware: str = parameter(
        "",
        "Program of the firmware core with the frames of 'dbc', e.g. firmware/build/board_posix, that is the emulated "
        "board; empty: none",
    )
    log: str = parameter(
        "", "File for all frames received and sent, a candump .log or a .blf by its ending; empty: none"
    )

    def __post_init__(self) -> None:
        self.further_options()
        if self.dbc or self.wire.given:
            # The package's own is known to be right, and reading it takes half a second.
            self.make_wire()
        if self.log and not self.log.lower().endswith(_LOG_ENDINGS):
            raise RefusedParameter("log", f"'{self.log}' is not allowed; allowed: *{' or *'.join(_LOG_ENDINGS)}")

    def silences(self, rate: float) -> tuple[float, float]:
        """Times in s that latch a fault without a sample, of ``rate`` a second, and without the amplifier's state."""
        sample = max(self.sample_timeout, SILENT_SAMPLES / rate)
        return sample, max(self.heartbeat_timeout, sample)

    def make_wire(self) -> "Wire":
        """The frames of this board; raises RefusedParameter if DBC file and meaning do not fit together."""
        # Imported here: it needs the parameters above.
        from straightcomp_ros.hardware.can.board_dbc import wire_of

        if self.dbc:
            path = os.path.expanduser(self.dbc)
            modified = os.stat(path).st_mtime_ns if os.path.exists(path) else 0
            return wire_of(self.dbc, modified, self.wire, self.node, self.fd)
        for name, value in self.wire.given.items():
            raise RefusedParameter(f"wire.{name}", f"{value!r} is not allowed without a file in '{{group}}dbc'")
        return wire_of(SHIPPED_DBC, 0, shipped_wire(self.fd), self.node, self.fd)

    def further_options(self) -> dict[str, str]:
        """The pairs in ``options``; raises ParameterError for one that is not NAME=VALUE, or has a parameter."""
        pairs = {}
        for text in self.options.split():
            name, equals, value = text.partition("=")
            if not (name.isidentifier() and equals):
                raise RefusedParameter("options", f"'{text}' is not allowed; allowed: NAME=VALUE")
            if name in vars(self):
                raise RefusedParameter("options", f"'{text}' is not allowed; '{{group}}{name}' is for that")
            pairs[name] = value
        return pairs


def shipped_wire(fd: bool) -> WireParameters:
    """The meaning of the signals in config/straightcomp.dbc on CAN FD, or on a classic bus."""
    encoder, command = ("EncoderFd", "CommandFd") if fd else ("Encoder", "Command")
    slow = "" if fd else "CoilCurrent"
    current = ProtectionParameters("e2e_1", "CoilCurrentCrc", "CoilCurrentAlive")
    return WireParameters(
        x=QuantityParameters(encoder, "StageX"),
        y=QuantityParameters(signal="PlatformY"),
        current=QuantityParameters(slow, "MeasuredCurrent"),
        counter=SignalParameters(slow, "SampleCounter"),
        good=SwitchParameters(signal="EncodersValid"),
        amplifier=AmplifierParameters(signal="Amplifier"),
        fault=FaultParameters(signal="BoardFault"),
        referenced=SwitchParameters(slow, "Referenced"),
        heartbeat=HeartbeatParameters("Heartbeat", "NodeState"),
        command=QuantityParameters(command, "ControlCurrent"),
        enable=SwitchParameters(signal="Enable", no_value=1, yes_value=2),
        reset=SwitchParameters(signal="ResetFault", no_value=1, yes_value=2),
        echo=SignalParameters(signal="EchoedCounter"),
        protection=ProtectedMessages(
            sample=ProtectionParameters("e2e_1", "EncoderCrc", "EncoderAlive"),
            current=ProtectionParameters() if fd else current,
            command=ProtectionParameters("e2e_1", "CommandCrc", "CommandAlive"),
        ),
    )
