"""Plausibility checks of samples and clocks."""

import math
import sys
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from straightcomp_ros.control.pairing import RUN_GAP_NS
from straightcomp_ros.hardware.interface import Sample
from straightcomp_ros.model.motion import StageLimits
from straightcomp_ros.model.paced_motion import PacedMotion
from straightcomp_ros.parameters.declaration import parameter
from straightcomp_ros.safety.faults import Fault, Finding
from straightcomp_ros.stage.description import StageParameters

_MEAN_TIME = 0.005
"""s, time constant of the mean control current, which suppresses a law's switching."""
_LONGEST_FROZEN = 0.25
"""s, half of the time within which a frozen y is found (`Fault.Y_FROZEN`): in the other half the current rises."""
_BEYOND = 1.2


@dataclass(frozen=True)
class WatchParameters:
    """Limits that a working machine does not exceed."""

    y_limit: float = parameter(1e-3, "Largest |y|, once y was within it with the amplifier on", "(0, 0.1] m")
    travel: float = parameter(
        0.1, "Largest movement of y since the amplifier was switched on, for commissioning in open loop", "(0, 0.1] m"
    )
    frozen_time: float = parameter(
        0.01,
        "Time without a change of y, under a current that must move it, after which it is frozen; on a heavy platform "
        "up to 0.25 s, where half of the largest current does not move it sooner",
        "(0, 10] s",
    )
    frozen_current: float = parameter(
        0.0,
        "Change of the mean control current that must move y by a count; 0: by the description of the stage, at the "
        "most friction and the least force of its uncertainty",
        "[0, 100] A",
    )
    follow_distance: float = parameter(
        0.02, "Length of the stage's trajectory over which x must move by a count", "(0, 10] m"
    )
    clock_step: float = parameter(
        0.05, "Step of the system's clock that is a fault; a slewed clock is not", "(0, 3600] s"
    )


def moving_current(stage: StageParameters, time: float) -> float:
    """Change of the control current in A that must move the platform by a count within ``time`` in s, on each machine
    of ``stage.uncertainty``.

    It takes friction from −F_S to F_S, and a count against magnets and flexure, with the least K̄_i; `_BEYOND` is for
    friction that grows while it holds. A platform that slides may stay within a count h while the force turns it back,
    as what is thrown up and falls again: that takes an acceleration of 8 h / time².
    """
    ranges = stage.uncertainty
    friction = _BEYOND * stage.friction.static * ranges.friction
    turned = stage.platform.mass * (1.0 + ranges.mass) * 8.0 * stage.encoder.y_resolution / time**2
    least = stage.actuator.current_stiffness * (1.0 - ranges.force) / (1.0 + ranges.air_gap) ** 2
    return 2.0 * (friction + stage.quantum + turned) / least


class SampleWatch:
    """Checks each sample, of which a normal one costs three comparisons and a mean."""

    def __init__(self, parameters: WatchParameters, stage: StageParameters) -> None:
        self._parameters = parameters
        self.travel = parameters.travel
        """Largest movement of y since the amplifier was switched on, m; a change holds from the next switch-on."""
        self._period_ns = period_ns = stage.period_ns
        self._fastest, self._noise = stage.motion.highest_speed * 1e-9, stage.encoder.x_noise
        self._x_step = self._fastest * period_ns + self._noise
        self._frozen_current, time, memory = parameters.frozen_current, parameters.frozen_time, _MEAN_TIME
        if not self._frozen_current:
            # What lasts shorter than the mean's memory does not show in it.
            time = max(time, memory)
            # A current that no law reaches would find nothing: a heavy platform has more time, and so has the mean, in
            # which a coarse count lets the current oscillate slowly.
            while moving_current(stage, time) > 0.5 * stage.highest_current and 2.0 * time <= _LONGEST_FROZEN:
                time, memory = 2.0 * time, 2.0 * memory
            self._frozen_current = moving_current(stage, time)
        self._share = 1.0 - math.exp(-period_ns * 1e-9 / memory)
        # A command acts after its delay: the first sample with a larger current says nothing yet.
        self._frozen_samples = max(2, math.ceil(time / (period_ns * 1e-9)))
        self.restart()

    def restart(self) -> None:
        """Forget the samples before an interruption."""
        self._x, self._stamp_ns = math.nan, 0
        self.switched(on=False)

    def switched(self, on: bool) -> None:
        """The amplifier is switched, or a fault is cleared: the current begins at zero, and y may be anywhere; with the
        amplifier off it may also move anywhere."""
        self._y, self._resisted = math.nan, 0
        self._mean = self._mean_at_change = 0.0
        self._reach = self.travel if on else sys.float_info.max
        self._least = -sys.float_info.max
        self._most = sys.float_info.max
        self._start = math.nan

    def hold(self) -> None:
        """While the amplifier is on: once y is within its limit, it must stay there. Call it a few times a second."""
        limit = self._parameters.y_limit
        if abs(self._y) <= limit:
            self._least, self._most = max(self._least, -limit), min(self._most, limit)

    def check(self, sample: Sample, current: float) -> Finding | None:
        """The fault of a sample, if any; ``current`` (A) is the amplifier's command, 0 while it is off."""
        stamp_ns, x, y, _ = sample
        step = self._x_step
        if not -step <= x - self._x <= step or not self._least <= y <= self._most:
            finding = self._unusual(stamp_ns, x, y)
            if finding is not None:
                return finding
        self._x, self._stamp_ns = x, stamp_ns
        self._mean += self._share * (current - self._mean)
        if y != self._y:
            if math.isnan(self._y):
                # The first sample since the amplifier was switched.
                self._start, self._least, self._most = y, y - self._reach, y + self._reach
            self._y, self._resisted, self._mean_at_change = y, 0, self._mean
            return None
        change = self._mean - self._mean_at_change
        self._resisted = self._resisted + 1 if abs(change) > self._frozen_current else 0
        if self._resisted < self._frozen_samples:
            return None
        return Fault.Y_FROZEN, f"y stays at {y * 1e6:.1f} µm though the current changed by {change:+.2f} A"

    def _unusual(self, stamp_ns: int, x: float, y: float) -> Finding | None:
        if not (math.isfinite(x) and math.isfinite(y)):
            return Fault.SAMPLE_NOT_FINITE, f"sample with x = {x} m, y = {y} m"
        if abs(y - self._start) > self._reach:
            moved = f"y moved by {(y - self._start) * 1e6:.1f} µm since the amplifier was switched on"
            return Fault.FOLLOWING_ERROR, f"{moved}; allowed: ±{self._reach * 1e6:g} µm"
        if not self._least <= y <= self._most:
            return Fault.Y_OUT_OF_RANGE, f"y = {y * 1e6:.1f} µm; allowed: ±{self._parameters.y_limit * 1e6:g} µm"
        if math.isnan(self._x):
            return None
        # Lost samples are not a jump.
        if abs(x - self._x) <= self._fastest * max(self._period_ns, stamp_ns - self._stamp_ns) + self._noise:
            return None
        return Fault.X_JUMP, f"x went from {self._x * 1e3:.4f} to {x * 1e3:.4f} mm within one sample"


class StageWatch:
    """Checks that x moves while the trajectory does; call it about ten times a second.

    It detects nothing before x has moved for the first time, since the stage decides when it begins.
    """

    def __init__(self, parameters: WatchParameters) -> None:
        self._distance = parameters.follow_distance
        self._number = 0

    def check(self, stamp_ns: int, x: float, motion: PacedMotion) -> Finding | None:
        """The fault of a sample's x, if any; ``motion`` is that of the stage."""
        if not motion.number:
            return None
        expected = motion.position(stamp_ns)
        if motion.number != self._number:
            self._number, self._x, self._expected, self._moved = motion.number, x, expected, False
        elif x != self._x:
            self._x, self._expected, self._moved = x, expected, True
        way = expected - self._expected
        if not self._moved or abs(way) <= self._distance:
            return None
        self._moved = False
        return Fault.X_FROZEN, f"x stays at {x * 1e3:.4f} mm; the stage was to move by {way * 1e3:+.1f} mm meanwhile"


class ZeroWatch:
    """Whether x that is referenced anew is counted from where it was before.

    That can be said where the encoder has counted on meanwhile. After a loss of counts or of samples any reference is
    accepted: where the stage is, is not known.

    Attributes:
        finding: what is wrong with the zero of x; empty if nothing is known to be.
    """

    def __init__(self, stage: StageParameters) -> None:
        self._bend = StageLimits.of(stage.motion, 0.0, 0.0).acceleration * 1e-18
        # An extrapolation from two readings has the noise of two differences.
        self._noise, self._fastest = 2.0 * stage.encoder.x_noise, stage.motion.highest_speed * 1e-9
        self._samples = deque[Sample](maxlen=2)
        self._referenced = self._counted = False
        self._shift, self.finding = 0.0, ""

    def look(self, samples: Sequence[Sample], referenced: bool) -> None:
        """Take all samples while x is not referenced, the last one before and the first ones after that."""
        jump = sum(map(self._jump, samples))
        known = self._counted and not math.isnan(jump)
        if referenced and not self._referenced and known:
            self._shift += jump
            moved = f"the zero of x has moved by {self._shift * 1e3:+.4f} mm since it was referenced before"
            remedy = "home again, or align the map (straightcomp map align) and start the driver anew"
            self.finding = f"{moved}; {remedy}" if abs(self._shift) > self._noise else ""
        self._counted = referenced or (known and jump == 0.0)
        self._referenced = referenced

    def _jump(self, sample: Sample) -> float:
        """Change of x in m that is no motion of the stage; NaN where that is not known."""
        first, last = (self._samples[0], self._samples[-1]) if self._samples else (sample, sample)
        before_ns, after_ns = last.stamp_ns - first.stamp_ns, sample.stamp_ns - last.stamp_ns
        if after_ns > RUN_GAP_NS:
            self._samples.clear()
        self._samples.append(sample)
        if not 0 < after_ns <= RUN_GAP_NS:
            return math.nan
        jump = sample.x - last.x - ((last.x - first.x) / before_ns * after_ns if before_ns else 0.0)
        moved = self._bend * after_ns * (after_ns + before_ns) if before_ns else self._fastest * after_ns
        return jump if abs(jump) > self._noise + moved else 0.0


class ClockWatch:
    """Compares the system's clock with the monotonic one: a step is a fault, a slewed clock is followed."""

    def __init__(
        self, parameters: WatchParameters, monotonic_ns: Callable[[], int], system_ns: Callable[[], int]
    ) -> None:
        self._monotonic_ns, self._system_ns = monotonic_ns, system_ns
        self._step_ns = round(parameters.clock_step * 1e9)
        self._offset_ns = 0

    def restart(self) -> None:
        """Take the clocks' present offset as the reference."""
        self._offset_ns = self._system_ns() - self._monotonic_ns()

    def check(self, monotonic_ns: int, system_ns: int) -> Finding | None:
        """The fault of two readings of the clocks, taken one right after the other, if any."""
        if -self._step_ns <= system_ns - monotonic_ns - self._offset_ns <= self._step_ns:
            return None
        # If the process stalled between the two readings, there was no step: read again.
        before, system, after = self._monotonic_ns(), self._system_ns(), self._monotonic_ns()
        offset_ns = system - (before + after) // 2
        step_ns = offset_ns - self._offset_ns
        if abs(step_ns) <= self._step_ns or after - before >= self._step_ns // 2:
            return None
        self._offset_ns = offset_ns
        return Fault.CLOCK_JUMP, f"the system's clock was stepped by {step_ns * 1e-9:+.3f} s"

    def follow(self) -> None:
        """Follow a slewed clock; call it a few times a second."""
        offset_ns = self._system_ns() - self._monotonic_ns()
        if abs(offset_ns - self._offset_ns) < self._step_ns // 2:
            self._offset_ns = offset_ns


class ErrorWatch:
    """The following error r − y, once it was within its limit with the amplifier on; NaN is beyond it."""

    def __init__(self, limit: float) -> None:
        self.limit = limit  # m; may be changed
        self._held = False

    def check(self, error: float, *, amplifier_on: bool) -> Finding | None:
        """The fault of a sample with ``error`` in m, if any; reported once."""
        held, self._held = self._held, amplifier_on and abs(error) <= self.limit
        if self._held or not (held and amplifier_on):
            return None
        where = f"the platform is {error * 1e6:.1f} µm from its reference"
        return Fault.FOLLOWING_ERROR, f"{where}; allowed: ±{self.limit * 1e6:g} µm"
