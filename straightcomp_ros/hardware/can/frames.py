"""What the frames of a board and of its host say; how they lie on the wire is in the DBC file alone."""

import enum
from typing import NamedTuple

EXTENDED_ID = 1 << 31
"""Set in an identifier of 29 bits, as in DBC files and in Linux's frames."""


class Amplifier(enum.IntEnum):
    """State of the board's amplifier."""

    OFF = 1
    ON = 2
    FAULT = 3


class BoardFault(enum.IntEnum):
    """Why the emulated board switched off; the DBC file's table of the fault's values has these names."""

    NONE = 0
    COMMAND_TIMEOUT = 1
    COMMAND_CHECK = 2
    CURRENT_RANGE = 3
    ENCODER = 4
    OVERCURRENT = 5
    SUPPLY = 6
    INTERNAL = 7

    @property
    def words(self) -> str:
        return self.name.lower().replace("_", " ")


class FrameError(ValueError):
    """A frame fails its check; its text is the name under which such frames are counted."""


class Report(NamedTuple):
    """A frame of the board. What is not in the frame is None, except for ``good``.

    ``alive`` counts the frames of one identifier, ``counter`` the samples; ``x``, ``y`` and the coil ``current`` are in
    m and A, of the sample that the frame belongs to; ``fault`` is the board's own code; ``good`` says whether both
    readings may be used.
    """

    alive: int | None = None
    counter: int | None = None
    x: float | None = None
    y: float | None = None
    current: float | None = None
    amplifier: Amplifier | None = None
    fault: int | None = None
    good: bool = True


class Command(NamedTuple):
    """What the host asks for. What is not in the frame is None.

    ``alive`` counts the frames of one identifier; ``current`` is the control current in A; ``echo`` is the number of
    the sample that is answered, as far as the frame has room.
    """

    alive: int | None = None
    enable: bool | None = None
    reset: bool | None = None
    current: float | None = None
    echo: int | None = None


UNITS = {"x": "m", "y": "m", "current": "A"}
"""SI unit of each field of a report or command that has a physical value."""


def counted(report: Report) -> int | None:
    """What numbers the sample of a frame: the counter of the samples if the frame has it, else that of the frames."""
    return report.alive if report.counter is None else report.counter
