"""What the driver needs of a machine: take samples, give commands, switch the amplifier.

Times are ns since the epoch on the caller's clock, which must not step; the caller passes them in, so
that a backend behaves the same in real time, in lockstep and offline.
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from straightcomp_ros.model.stage import Trajectory
from straightcomp_ros.safety.faults import Fault


class Sample(NamedTuple):
    """One simultaneous reading of both encoders.

    ``stamp_ns`` is the time of the reading and the sample's identity; x and y in m; ``current`` is the
    measured control current of the coils in A, NaN while the amplifier is off.
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
    """State of the amplifier as the hardware reports it."""

    OFF = "off"
    ON = "on"
    FAULT = "fault"


class HardwareError(RuntimeError):
    """The machine refused or is not there; the message says which and why."""


class Hardware(ABC):
    """A machine. Backends implement these few calls; none of them blocks."""

    @abstractmethod
    def start(self, now_ns: int) -> None:
        """Begin sampling; the first sample is taken at ``now_ns``. Again after a pause in which nobody read."""

    @abstractmethod
    def read(self, now_ns: int) -> Sequence[tuple[Sample, Truth | None]]:
        """Samples taken since the last call up to ``now_ns``, oldest first.

        A board keeps a bounded number of samples for a host that is late; older ones are lost (see
        :attr:`lost_samples`). It does not guarantee that any sample is new.
        """

    @abstractmethod
    def write(self, current: float, at_ns: int, sample_ns: int | None = None) -> None:
        """Ask for a control current in A, in effect from ``at_ns`` (now, if that has passed).

        ``sample_ns`` is the stamp of the sample that it answers, if given: a board may refuse an old answer, and let
        one that comes early wait for a fixed time after its sample.

        Raises:
            ValueError: not finite. Nothing is sent then.
        """

    @abstractmethod
    def enable(self) -> None:
        """Switch the amplifier on, control current zero.

        Raises:
            HardwareError: a fault is latched.
        """

    @abstractmethod
    def disable(self) -> None:
        """Switch the amplifier off: bias and control current go to zero, the magnets pull to no side."""

    @abstractmethod
    def reset_fault(self) -> None:
        """Clear a latched fault; the amplifier stays off."""

    @abstractmethod
    def move(self, trajectory: Trajectory, start_ns: int) -> None:
        """Move the stage along X, if this machine's stage takes orders from here.

        Raises:
            HardwareError: it does not.
        """

    @property
    @abstractmethod
    def state(self) -> State:
        """State of the amplifier."""

    @property
    @abstractmethod
    def fault(self) -> str:
        """Why the state is FAULT; empty otherwise."""

    @property
    @abstractmethod
    def fault_kind(self) -> Fault | None:
        """Which fault that is; None without one."""

    @property
    @abstractmethod
    def lost_samples(self) -> int:
        """Samples that were taken but fetched too late, since the start."""

    @property
    @abstractmethod
    def applied_current(self) -> float:
        """Control current in A that is asked of the amplifier at present."""

    @property
    def newest_arrival_ns(self) -> int | None:
        """When the newest sample came in, if this machine sends samples by itself: then :meth:`wait` for them."""
        return None

    def wait(self, timeout_ns: int) -> None:
        """Take in what the machine has sent; if nothing, wait for it, up to ``timeout_ns``.

        Only for a machine that sends samples by itself; :meth:`read` has only those that were taken in here.
        """
        raise NotImplementedError

    def counters(self) -> Mapping[str, object]:
        """What this backend counts besides lost samples, for diagnostics."""
        return {}

    def close(self) -> None:
        """Release the machine; the amplifier is off afterwards."""
        self.disable()
