"""Parameters of a board on CAN."""

from dataclasses import dataclass

from straightcomp_ros.hardware.can.wire import Wire, make_wire
from straightcomp_ros.hardware.can.wire_parameters import WireParameters
from straightcomp_ros.parameters.declaration import RefusedParameter, group, parameter

_LOG_ENDINGS = (".log", ".blf")


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
    command_timeout: float = parameter(0.005, "Age of a command from which it is not sent any more", "(0, 1] s")
    sample_timeout: float = parameter(
        0.005, "Time without a sample that latches a fault while the amplifier is on", "(0, 1] s"
    )
    heartbeat_timeout: float = parameter(
        0.15,
        "Time without the board's heartbeat, or without the amplifier's state where that has frames of its own, that "
        "latches a fault",
        "(0, 10] s",
    )
    answer_timeout: float = parameter(0.1, "Longest wait for the board to switch on or to clear a fault", "(0, 10] s")
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
        if self.dbc or self.wire != WireParameters():
            # The package's own is known to be right, and reading it takes half a second.
            self.make_wire()
        if self.log and not self.log.lower().endswith(_LOG_ENDINGS):
            raise RefusedParameter("log", f"'{self.log}' is not allowed; allowed: *{' or *'.join(_LOG_ENDINGS)}")

    def make_wire(self) -> Wire:
        """The frames of this board; raises RefusedParameter if DBC file and meaning do not fit together."""
        return make_wire(self.dbc, self.wire, self.node, self.fd)

    def further_options(self) -> dict[str, str]:
        """The pairs in ``options``; raises ParameterError for one that is not NAME=VALUE."""
        pairs = {}
        for text in self.options.split():
            name, equals, value = text.partition("=")
            if not (name.isidentifier() and equals):
                raise RefusedParameter("options", f"'{text}' is not allowed; allowed: NAME=VALUE")
            pairs[name] = value
        return pairs
