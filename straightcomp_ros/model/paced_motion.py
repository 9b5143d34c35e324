"""The stage's motion while it runs: held, let go on, slowed down and ended, without leaving its trajectory.

The stage is where its trajectory x(τ) is at the path time τ. The pace u = dτ/dt is 1 unless less was asked for, so
the stage goes through the same positions in the same order at any pace, and the reference r(x) with it:

    ẋ = x' u,   ẍ = x'' u² + x' u̇

u goes to the pace asked for as quickly as ẍ within ±A and a rate of x' u̇ within J allow; where the trajectory itself
brakes, nothing is left, and it brakes by itself. From a speed v the stage thus stands after v/A and some A/J. Where the
trajectory turns or rests, x' is zero and u is limited by J/A alone.
"""

import math
from typing import NamedTuple

import numpy as np

from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint

_STEP_NS = 500_000
"""Longest step of the integration of u."""
_BUILD_S = 0.01
"""Time in s in which the acceleration of a stop builds up on a stage whose strokes have no limit of the jerk: a fifth
of the 50 ms within which a stop is to end beyond v/A, since its acceleration changes by up to 2 A, and by A again."""
_LEAST_SPEED = 1e-9
"""m/s, in place of zero as a divisor."""
_SAME_SPEED = 1e-6
"""Difference in m/s that no step of the acceleration shows: of 2 mm/s² within a sample."""
AT_START_M = 1e-6
"""From the stage, or from a reading of x, which is half a count off: so far a trajectory may begin from it."""
ARRIVED_M = 10e-6
"""From its goal, besides the half count by which a reading of x is off: so far from it a stage has arrived."""
_KNOTS = 32
"""Of the way to a trajectory that begins later: between them the quintic is followed by cubics."""
_RESERVE = 0.5
"""Share of the jerk by which u is foreseen to brake: x' may grow meanwhile."""


class Pace(NamedTuple):
    """What is asked of a motion: a fraction of its speed, to stand until further notice, to end where it can."""

    override: float = 1.0
    hold: bool = False
    end: bool = False


class StageState(NamedTuple):
    """A motion of the stage as the driver reports it."""

    condition: str = "rest"  # rest, moving, stopping or held; empty while no driver reports it
    override: float = 1.0  # fraction of the speed of the stage's motions
    behind_ns: int = 0  # time by which the motion is behind its trajectory, 0 at rest
    cut: bool = False  # it is cut short: see PacedMotion
    number: int = 0  # motions that the driver has begun
    ended: bool = False  # the last one was ended on its way


class PacedMotion:
    """A stage at rest at ``x`` (m) that takes trajectories; times in ns are of one clock and do not go back. ``count``
    (m) is that of the encoder of x, at whose readings trajectories begin.

    A motion is cut short from the first request for another pace until it ends. What is to be learned from the error of
    strokes is not learned from it.

    Attributes:
        pace: as asked for last; ``end`` is done, and ``hold`` with it, once the stage stands.
        cut: whether the present motion is cut short.
        number: motions begun.
        ended: whether the last one was ended on its way.
        half_count: so far in m a reading of x is off.
    """

    def __init__(self, motion: MotionParameters, x: float = 0.0, count: float = 0.0) -> None:
        self.half_count = 0.5 * count
        self._acceleration = motion.acceleration
        self._build = motion.acceleration / motion.jerk if motion.jerk else _BUILD_S
        self._set(Pace())
        self.cut, self.ended, self.number = False, False, 0
        self._at_ns = self._start_ns = 0
        self._u, self._rate = 1.0, 0.0
        self._rest(x)

    def _rest(self, x: float) -> None:
        self._trajectory, self._path_ns, self._limit = Trajectory([Waypoint(0, x, 0.0)]), 0.0, self._acceleration
        self.cut = False

    def joined(self, trajectory: Trajectory, start_ns: int, zero: float = 0.0) -> Trajectory:
        """A trajectory from ``start_ns`` on; if its first point comes later, with the way of the stage to that in front
        of it: from rest a cubic, in motion a quintic, which begins with the stage's acceleration and ends with that of
        the trajectory. Its positions are from ``zero`` (m) on."""
        if trajectory.times[0] <= 0:
            return trajectory
        from scipy.interpolate import BPoly

        end_ns, here = int(trajectory.times[0]), self.position(start_ns) - zero
        now = here, self._velocity, self._trajectory.rates(self._path_ns)[1]
        then = trajectory.positions[0], trajectory.velocities[0], trajectory.rates(end_ns)[1]
        way = BPoly.from_derivatives([0.0, end_ns * 1e-9], [now, then])
        times = np.linspace(0, end_ns, min(_KNOTS, end_ns) if self._velocity else 1, endpoint=False, dtype=np.int64)
        in_front = times, way(times * 1e-9), way(times * 1e-9, 1)
        then_on = trajectory.times, trajectory.positions, trajectory.velocities
        return Trajectory.from_columns(*map(np.append, in_front, then_on))

    def begin(self, trajectory: Trajectory, start_ns: int) -> None:
        """Take a trajectory that starts at ``start_ns``, :meth:`joined` to the motion that there is, with its pace.

        Raises:
            ValueError: the stage is elsewhere then, or has another speed, also where it stands.
        """
        trajectory, here = self.joined(trajectory, start_ns), self.position(start_ns)
        first = trajectory.position(0)
        if abs(first - here) > AT_START_M + self.half_count:
            raise ValueError(f"stage trajectory starts at {first} m, but the stage stands at {here} m")
        moving, speed = self.moving, trajectory.rates(0)[0]
        if abs(speed - self._velocity) > _SAME_SPEED:
            raise ValueError(
                f"stage trajectory starts at {speed:g} m/s, but the stage moves at {self._velocity:g} m/s; end its "
                "motion first, or let the first point come later than 0 s"
            )
        if not moving:
            self._u, self._rate = self._target, 0.0
        # A start in the past is one: the stage is on its way by now.
        self._trajectory, self._start_ns, self.number, self.ended = trajectory, start_ns, self.number + 1, False
        self._path_ns = float(self._at_ns - start_ns)
        self._limit = max(self._acceleration, trajectory.largest_acceleration)
        self._set(self.pace._replace(end=False))
        self.cut = moving or self._target != 1.0

    def ask(self, pace: Pace) -> None:
        """Ask for another pace, from the last time on that was looked at; ValueError for an override out of range."""
        if not 0.0 <= pace.override <= 1.0:
            raise ValueError(f"override {pace.override}; allowed: 0 to 1")
        self._set(pace)
        self.cut = self.cut or (not self.over and self._target != 1.0)
        if self.over:
            self._u, self._rate = self._target, 0.0
            self._set(Pace(pace.override) if pace.end else pace)

    def position(self, now_ns: int) -> float:
        """Position in m at ``now_ns``, or at the latest time asked for if that is later."""
        while self._at_ns < now_ns:
            left_ns = now_ns - self._at_ns
            if self._rate == 0.0 and self._u == self._target:
                self._path_ns += self._u * left_ns
                self._at_ns = now_ns
            else:
                step_ns = min(left_ns, _STEP_NS)
                self._path_ns += self._step(step_ns * 1e-9) * step_ns
                self._at_ns += step_ns
        if self._u == 0.0 and self.pace.end:
            self.ended = True
            self._rest(self._trajectory.position(self._path_ns))
            self._set(Pace(self.pace.override))
            self._u = self._target
        elif self.cut and self.over:
            self.cut = False
        return self._trajectory.position(self._path_ns)

    def _set(self, pace: Pace) -> None:
        self.pace, self._target = pace, 0.0 if pace.hold or pace.end else pace.override

    @property
    def over(self) -> bool:
        """Whether the trajectory has ended."""
        return self._path_ns >= self._trajectory.end_ns

    def lasts(self, period_ns: int) -> bool:
        """Whether the trajectory has not ended after another ``period_ns``."""
        return self._path_ns + self._u * period_ns < self._trajectory.end_ns

    def state(self, period_ns: int = 0) -> StageState:
        """The state now; at rest if the motion ends within ``period_ns``, in which lockstep takes no sample."""
        condition, behind_ns = (self.condition, self.behind_ns) if self.lasts(period_ns) else ("rest", 0)
        return StageState(condition, self.pace.override, behind_ns, self.cut, self.number, self.ended)

    @property
    def moving(self) -> bool:
        """Whether the stage has a speed."""
        return self._u != 0.0 and self._trajectory.rates(self._path_ns) != (0.0, 0.0)

    @property
    def condition(self) -> str:
        """``rest`` without a motion, ``held``, ``stopping`` on the way to that, ``moving`` else, pauses included."""
        if self.over:
            return "rest"
        return "moving" if self._target else "stopping" if self._u else "held"

    @property
    def behind_ns(self) -> int:
        """Time by which the motion is behind its trajectory."""
        return round(self._at_ns - self._start_ns - self._path_ns) if not self.over else 0

    @property
    def _velocity(self) -> float:
        """Of the trajectory, m/s; 0 for a stage that stands on its way."""
        return self._trajectory.rates(self._path_ns)[0] if self._u else 0.0

    def _step(self, dt: float) -> float:
        """Let u change for ``dt`` s; returns its mean meanwhile."""
        velocity, acceleration = self._trajectory.rates(self._path_ns)
        speed, along = abs(velocity), math.copysign(1.0, velocity) * acceleration
        u, rate, target = self._u, self._rate, self._target
        # Where x' is small, u is limited by itself.
        fastest, speed = 1.0 / self._build, max(speed, _LEAST_SPEED)
        quick, bent = min(fastest, self._limit / speed) * fastest, along * u * u
        low, high = max(-fastest, (-self._limit - bent) / speed), min(fastest, (self._limit - bent) / speed)
        left = target - u
        reach = _RESERVE * quick
        wanted = math.copysign(math.sqrt(0.25 * reach * reach * dt * dt + 2.0 * reach * abs(left)), left)
        wanted -= math.copysign(0.5 * reach * dt, left)
        rate = min(max(wanted, rate - quick * dt), rate + quick * dt)
        rate = min(max(rate, low), high)  # at a corner of the trajectory at once
        after = u + rate * dt
        if abs(target - after) <= quick * dt * dt and abs(rate) <= 2.0 * quick * dt:
            after, rate = target, 0.0
        self._u, self._rate = min(max(after, 0.0), 1.0), rate
        if after < 0.0:
            self._rate = 0.0
        return 0.5 * (u + self._u)
