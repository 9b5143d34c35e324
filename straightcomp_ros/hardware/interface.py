"""What the driver needs of a machine: take samples, give commands, switch the amplifier.

Times are ns since the epoch on the caller's clock, which must not step. The caller passes them in, so that a backend
behaves the same in real time, in lockstep and offline.
"""

import enum
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from straightcomp_ros.model.motion import Trajectory
from straightcomp_ros.model.paced_motion import Pace, PacedMotion
from straightcomp_ros.safety.faults import Finding

SILENT_SAMPLES = 3
"""Samples at least, or commands, whose absence is a silence: a single one that is lost is none, at any rate."""


class Sample(NamedTuple):
    """One simultaneous reading of both encoders, in m, identified by its time.

    ``current`` is the measured control current of the coils in A, NaN while the amplifier is off.
    """

    stamp_ns: int
    x: float
    y: float
    current: float


class Truth(NamedTuple):
    """What only a simulation knows of a sample: m, m/s, N, and the guide's deviation δ(x) in m."""

    x: float
    y: float
    velocity: float
    friction_force: float
    magnetic_force: float
    guide_deviation: float


class State(enum.Enum):
    """State of the amplifier: as the machine reports it, or as the driver's safety state machine has it."""

    OFF = "off"
    ON = "on"
    FAULT = "fault"


class HardwareError(RuntimeError):
    """The machine refused or cannot be reached; the message says which and why."""


class Hardware(ABC):
    """A machine. None of these calls blocks but :meth:`wait`.

    Attributes:
        motion: of the stage; where the stage is another computer's, a copy that follows what is sent to it.
        zero: position in that motion at which x reads zero, m.
    """

    motion: PacedMotion
    zero = 0.0

    @abstractmethod
    def start(self, now_ns: int) -> None:
        """Begin sampling, or begin again after a pause without reading; take the first sample at ``now_ns``."""

    @abstractmethod
    def read(self, now_ns: int) -> Sequence[tuple[Sample, Truth | None]]:
        """Samples taken since the last call up to ``now_ns``, oldest first; there may be none.

        A board keeps a bounded number of samples for a late host; :attr:`lost_samples` counts the others.
        """

    @abstractmethod
    def write(self, current: float, at_ns: int, sample_ns: int | None = None) -> None:
        """Ask for a control current in A, in effect from ``at_ns`` (now, if that has passed).

        ``sample_ns`` is the stamp of the sample that it answers, if given: a board may refuse an old answer, and delay
        an early one until a fixed time after its sample. Raises ValueError if the current is not finite or too large.
        """

    @abstractmethod
    def enable(self) -> None:
        """Switch the amplifier on with control current zero; raises HardwareError if the machine refuses."""

    @abstractmethod
    def disable(self) -> None:
        """Switch the amplifier off: bias and control current go to zero, and the magnets exert no net force."""

    @abstractmethod
    def reset_fault(self) -> None:
        """Clear a latched fault; the amplifier stays off."""

    @abstractmethod
    def move(self, trajectory: Trajectory, start_ns: int) -> None:
        """Move the stage along X; HardwareError if it takes no commands, ValueError as of :meth:`PacedMotion.begin`."""

    @abstractmethod
    def pace(self, pace: Pace) -> None:
        """Ask for another pace of the stage's motion, and of those to come; HardwareError if it takes no commands."""

    def home(self, now_ns: int) -> None:
        """Begin to reference x: the stage goes to its index mark, and to the start of its strokes; amplifier off.

        Raises:
            HardwareError: x is referenced by another computer, or not with the amplifier on.
            ValueError: the stage is moving.
        """
        raise HardwareError("the stage's own controller references x")

    @property
    @abstractmethod
    def state(self) -> State:
        """State of the amplifier."""

    @property
    @abstractmethod
    def fault(self) -> Finding | None:
        """The fault by which the state is FAULT, None otherwise."""

    @property
    @abstractmethod
    def lost_samples(self) -> int:
        """Samples that were taken but fetched too late, since the start."""

    @property
    @abstractmethod
    def applied_current(self) -> float:
        """Control current in A that is asked of the amplifier at present."""

    @property
    def unreferenced(self) -> str:
        """Why x must not be compensated: it is not counted from its reference. Empty if it is, or is not known."""
        return ""

    @property
    def stage_refusal(self) -> str:
        """Why the stage takes no commands; empty if it does."""
        return ""

    @property
    def link_problem(self) -> str:
        """Why the machine cannot be reached; empty if it can, or if that is not known."""
        return ""

    @property
    def newest_arrival_ns(self) -> int | None:
        """When the newest sample arrived; None for a machine that does not send samples by itself."""
        return None

    def wait(self, timeout_ns: int) -> None:
        """Receive for :meth:`read` what a machine sends by itself, waiting up to ``timeout_ns`` for the first of it."""
        raise NotImplementedError

    def remarks(self) -> Sequence[str]:
        """What a user must know of this machine before it runs, one sentence each."""
        return ()

    def counters(self) -> Mapping[str, object]:
        """Further counters of this backend, for diagnostics."""
        return {}

    def close(self) -> None:
        """Release the machine, with its amplifier off."""
        self.disable()
