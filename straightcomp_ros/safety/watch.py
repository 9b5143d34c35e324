"""Watches samples, commands and clocks for what a working machine cannot do."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass

from straightcomp_ros.hardware.interface import Sample
from straightcomp_ros.model.stage import Trajectory
from straightcomp_ros.safety.faults import Fault, Finding
from straightcomp_ros.settings.declaration import parameter

_MEAN_TIME = 0.005
"""s, of the mean control current: a law's switching goes into no movement."""
_STRIKE, _STRIKES = 4, 16


@dataclass(frozen=True)
class WatchParameters:
    """What a working machine cannot do."""

    max_speed: float = parameter(
        2.0, "Speed of the stage beyond which x has jumped", unit="m/s", above=0.0, maximum=100.0
    )
    y_limit: float = parameter(
        1e-3,
        "Largest |y|, once y was within it with the amplifier on",
        unit="m",
        above=0.0,
        maximum=0.1,
    )
    frozen_time: float = parameter(
        0.01, "Time without a change of y after which it may count as frozen", unit="s", above=0.0, maximum=10.0
    )
    frozen_current: float = parameter(
        0.08, "Change of the mean control current that must move y by a count", unit="A", above=0.0, maximum=100.0
    )
    follow_distance: float = parameter(
        0.02, "Length of the stage's trajectory over which x must move by a count", unit="m", above=0.0, maximum=10.0
    )
    clock_step: float = parameter(
        0.05, "Step of the system's clock that is a fault; a slewed clock is not", unit="s", above=0.0, maximum=3600.0
    )


class SampleWatch:
    """Looks at each sample once; an undisturbed one costs three comparisons and a mean.

    Args:
        parameters: limits.
        period_ns: of the samples.
    """

    def __init__(self, parameters: WatchParameters, period_ns: int) -> None:
        self._parameters = parameters
        self._period_ns = period_ns
        self._x_step = parameters.max_speed * period_ns * 1e-9
        self._share = 1.0 - math.exp(-period_ns * 1e-9 / _MEAN_TIME)
        self._frozen_samples = math.ceil(parameters.frozen_time / (period_ns * 1e-9))
        self._frozen_current = parameters.frozen_current
        self.restart()

    def restart(self) -> None:
        """Forget the samples so far: after a break they say nothing."""
        self._x, self._stamp_ns = math.nan, 0
        self.switched()

    def switched(self) -> None:
        """The amplifier has been switched on: the current was zero until now, and y may be anywhere."""
        self._y, self._unchanged = math.nan, 0
        self._mean = self._mean_at_change = 0.0
        self._y_limit = sys.float_info.max

    def hold(self) -> None:
        """The amplifier is on: y must stay within its limit, once it is there. To be called now and then."""
        if abs(self._y) <= self._parameters.y_limit:
            self._y_limit = self._parameters.y_limit

    def check(self, sample: Sample, current: float) -> Finding | None:
        """What is wrong with a sample, None for nothing; ``current`` is asked of the amplifier, A (0 while off)."""
        stamp_ns, x, y, _ = sample
        step = self._x_step
        if not -step <= x - self._x <= step or not -self._y_limit <= y <= self._y_limit:
            finding = self._unusual(stamp_ns, x, y)
            if finding is not None:
                return finding
        self._x, self._stamp_ns = x, stamp_ns
        self._mean += self._share * (current - self._mean)
        if y != self._y:
            self._y, self._unchanged, self._mean_at_change = y, 0, self._mean
            return None
        self._unchanged += 1
        if self._unchanged < self._frozen_samples or abs(self._mean - self._mean_at_change) <= self._frozen_current:
            return None
        return Fault.Y_FROZEN, (
            f"y stays at {y * 1e6:.1f} µm though the current changed by {self._mean - self._mean_at_change:+.2f} A"
        )

    def _unusual(self, stamp_ns: int, x: float, y: float) -> Finding | None:
        if not (math.isfinite(x) and math.isfinite(y)):
            return Fault.SAMPLE_NOT_FINITE, f"sample with x = {x} m, y = {y} m"
        if abs(y) > self._y_limit:
            return Fault.Y_OUT_OF_RANGE, f"y = {y * 1e6:.1f} µm; allowed: ±{self._y_limit * 1e6:g} µm"
        if math.isnan(self._x):
            return None
        # Lost samples are no jump.
        allowed = self._x_step * max(1.0, (stamp_ns - self._stamp_ns) / self._period_ns)
        if abs(x - self._x) <= allowed:
            return None
        return Fault.X_JUMP, f"x went from {self._x * 1e3:.4f} to {x * 1e3:.4f} mm within one sample"


class StageWatch:
    """Whether x moves at all while it is to move; to be asked some ten times a second.

    It says nothing before x has moved for the first time: when the stage begins is its own affair.
    """

    def __init__(self, parameters: WatchParameters) -> None:
        self._distance = parameters.follow_distance
        self._trajectory: Trajectory | None = None

    def follow(self, trajectory: Trajectory, start_ns: int, x: float) -> None:
        """The stage at ``x`` (m) was sent along a trajectory."""
        self._trajectory, self._start_ns = trajectory, start_ns
        self._x, self._stamp_ns, self._moved = x, start_ns, False

    def check(self, stamp_ns: int, x: float) -> Finding | None:
        """The same for a sample's x."""
        if self._trajectory is None:
            return None
        if x != self._x:
            self._x, self._stamp_ns, self._moved = x, stamp_ns, True
            return None
        before, now = (self._trajectory.position(time - self._start_ns) for time in (self._stamp_ns, stamp_ns))
        if not self._moved or abs(now - before) <= self._distance:
            return None
        self._moved = False
        return (
            Fault.X_FROZEN,
            f"x stays at {x * 1e3:.4f} mm; the stage was to move by {(now - before) * 1e3:+.1f} mm meanwhile",
        )


class ClockWatch:
    """The system's clock beside the monotonic one: a step is a fault, a clock that is slewed is followed.

    Args:
        parameters: limit.
        monotonic_ns, system_ns: the clocks.
    """

    def __init__(
        self, parameters: WatchParameters, monotonic_ns: Callable[[], int], system_ns: Callable[[], int]
    ) -> None:
        self._monotonic_ns, self._system_ns = monotonic_ns, system_ns
        self._step_ns = round(parameters.clock_step * 1e9)
        self._offset_ns = 0

    def restart(self) -> None:
        """Take the clocks as they stand."""
        self._offset_ns = self._system_ns() - self._monotonic_ns()

    def check(self, monotonic_ns: int, system_ns: int) -> Finding | None:
        """The same for both clocks, read one right after the other."""
        if -self._step_ns <= system_ns - monotonic_ns - self._offset_ns <= self._step_ns:
            return None
        # A process that stood still between the two readings has seen no step.
        before, system, after = self._monotonic_ns(), self._system_ns(), self._monotonic_ns()
        offset_ns = system - (before + after) // 2
        step_ns = offset_ns - self._offset_ns
        if abs(step_ns) <= self._step_ns or after - before >= self._step_ns // 2:
            return None
        self._offset_ns = offset_ns
        return Fault.CLOCK_JUMP, f"the system's clock was stepped by {step_ns * 1e-9:+.3f} s"

    def follow(self) -> None:
        """Go with a clock that is slewed; to be called now and then."""
        offset_ns = self._system_ns() - self._monotonic_ns()
        if abs(offset_ns - self._offset_ns) < self._step_ns // 2:
            self._offset_ns = offset_ns


class CommandWatch:
    """Counts strikes against commands that answer a sample again: one controller never does that."""

    def __init__(self) -> None:
        self._strikes = 0

    def good(self) -> None:
        """A command for a new sample."""
        if self._strikes:
            self._strikes -= 1

    def again(self) -> Finding | None:
        """A command for a sample that was answered already."""
        self._strikes += _STRIKE
        if self._strikes < _STRIKES:
            return None
        self._strikes = 0
        return Fault.TWO_CONTROLLERS, "samples are answered twice: somebody else publishes commands too"
