"""Parameters of a board on CAN."""

from __future__ import annotations

from dataclasses import dataclass

from straightcomp_ros.contract import DEFAULT_RATE
from straightcomp_ros.settings.declaration import RefusedParameter, parameter

LOG_ENDINGS = (".log", ".blf")
"""Formats of the frame log."""


@dataclass(frozen=True)
class CanParameters:
    """An encoder and DSP board on a CAN bus, through any interface of python-can."""

    interface: str = parameter("socketcan", "Type of CAN interface in python-can, e.g. socketcan, pcan, kvaser")
    channel: str = parameter("can0", "Channel of the CAN interface, as python-can names it")
    bitrate: int = parameter(
        1_000_000,
        "Bit rate of the bus; socketcan takes it from the system instead",
        unit="bit/s",
        minimum=10_000,
        maximum=1_000_000,
    )
    fd: bool = parameter(True, "Use CAN FD: the encoder frame carries the coil current too")
    data_bitrate: int = parameter(
        5_000_000, "Bit rate of the data phase of CAN FD", unit="bit/s", minimum=10_000, maximum=8_000_000
    )
    options: str = parameter("", "Further arguments for python-can, as NAME=VALUE separated by blanks")
    node: int = parameter(1, "Node id of the board", minimum=1, maximum=127)
    rate: int = parameter(
        DEFAULT_RATE, "Samples per second that the board takes", unit="Hz", minimum=10, maximum=20_000
    )
    command_timeout: float = parameter(
        0.005, "Age beyond which a command is not sent; the board has the same limit", unit="s", above=0.0, maximum=1.0
    )
    sample_timeout: float = parameter(
        0.005, "Time without a sample that latches a fault while the amplifier is on", unit="s", above=0.0, maximum=1.0
    )
    heartbeat_timeout: float = parameter(
        0.15, "Time without a heartbeat after which the board counts as lost", unit="s", above=0.0, maximum=10.0
    )
    answer_timeout: float = parameter(
        0.1, "Longest wait for the board to switch on or to clear a fault", unit="s", above=0.0, maximum=10.0
    )
    strike_limit: int = parameter(
        16,
        "Error counter at which a fault is latched: a frame that fails its check adds 4, a good one takes 1 off",
        minimum=4,
        maximum=1000,
    )
    x_speed: float = parameter(
        2.0, "Speed of the stage above which a frame's x is taken for wrong", unit="m/s", above=0.0, maximum=100.0
    )
    y_speed: float = parameter(
        0.5, "Speed of the platform above which a frame's y is taken for wrong", unit="m/s", above=0.0, maximum=100.0
    )
    sample_memory: int = parameter(256, "Samples that are kept for a late driver", minimum=1, maximum=100_000)
    simulated_stage: bool = parameter(
        False,
        "The board is the emulator: send it stage trajectories, and on CAN FD receive the simulation's truth",
    )
    log: str = parameter(
        "", "File for all frames sent and received: candump's .log or .blf, by its ending; empty for none"
    )

    def __post_init__(self) -> None:
        self.further_options()
        if self.log and not self.log.lower().endswith(LOG_ENDINGS):
            raise RefusedParameter("log", f"'{self.log}' is not allowed; allowed: *{' or *'.join(LOG_ENDINGS)}")

    def further_options(self) -> dict[str, str]:
        """The pairs in ``options``.

        Raises:
            ParameterError: one of them is no pair.
        """
        pairs = {}
        for text in self.options.split():
            name, equals, value = text.partition("=")
            if not (name.isidentifier() and equals):
                raise RefusedParameter("options", f"'{text}' is not allowed; allowed: NAME=VALUE")
            pairs[name] = value
        return pairs
