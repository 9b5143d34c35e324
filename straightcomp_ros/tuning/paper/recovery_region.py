"""From which position and velocity a law brings the platform back, and from which the magnets could at all.

With |i_c| <= I0 the force of (2) is the more negative the more negative i_c, wherever the platform is, and with
i_c = −I0 it is −μ0 N² A I0² / (y0 + y)²: the near magnet is off. So there is no point of no return inside the air gap,
and a platform is lost only if it moves outward so fast that even full current does not stop it before its stop.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.laws import make_law
from straightcomp_ros.model.plant import PlantState, advance, as_array
from straightcomp_ros.offline.kernel import Conditions, run_cycle
from straightcomp_ros.tuning.paper.ideal_machine import Machine
from straightcomp_ros.tuning.paper.release import largest

RETURNED = 0.01
"""|y/y0| within which the platform must stay at the end."""
_DURATION = 0.5
"""s; the slowest law needs 0.17 from 0.6 y0."""
_HELD = 0.01
"""s at the end for which the platform must have stayed."""
_FULL_CURRENT_FOR = 0.1
"""s; from one stop to the other it takes 0.03."""
_BESIDE_STOP = 0.95
"""Part of the air gap to which the stop is moved in the simulation, so that a touch between two samples is not lost."""


@dataclass(frozen=True, eq=False)
class StartGrid:
    """Positions (p,) in m and velocities (v,) in m/s at the start, both symmetric about zero and odd in number."""

    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]

    def filled(self, value: Callable[[float, float], float]) -> NDArray[np.float64]:
        """``value(y, velocity)`` at all points, (v, p); computed for velocities >= 0, mirrored through the centre."""
        upper = np.array(
            [[value(y, v) for y in self.positions.tolist()] for v in self.velocities.tolist() if v >= 0.0], dtype=float
        )
        return np.concatenate([upper[:0:-1, ::-1], upper])


def start_grid(machine: Machine, points: int) -> StartGrid:
    """All positions between the stops, and all velocities that any of them allows; ``points`` each way, odd."""
    stop = machine.plant.platform.stop
    fastest = fastest_outward(machine, -stop)
    return StartGrid(np.linspace(-stop, stop, points), np.linspace(-fastest, fastest, points))


def fastest_outward(machine: Machine, y: float) -> float:
    """Largest ẏ in m/s at ``y`` in m that i_c = −I0, at once, brings to zero before the stop; without friction.

    The work of −μ0 N² A I0² / (y0 + y)² up to the stop is the kinetic energy.
    """
    actuator = machine.plant.actuator
    strength = actuator.current_stiffness * actuator.bias_current * actuator.air_gap**2
    work = strength * (1.0 / (actuator.air_gap + y) - 1.0 / (actuator.air_gap + machine.plant.platform.stop))
    return math.sqrt(2.0 * max(0.0, work) / machine.plant.platform.mass)


def possible(machine: Machine, y: float, velocity: float) -> bool:
    """Whether some current within ±I0, if it came at once, would keep the platform off its stops."""
    stop = machine.plant.platform.stop
    return abs(y) < stop and velocity < fastest_outward(machine, y) and -velocity < fastest_outward(machine, -y)


def least_peak(machine: Machine, y: float, velocity: float) -> float:
    """Largest way in m toward either stop under full current away from it, through amplifier and delay.

    The first command acts late by the delay, and the current rises from zero. No law of this machine can do better: at
    any time no current leaves the platform further from a stop than full current away from it. The
    mechanical stop is out of the way, as in :func:`peak`.
    """
    return max(_under_full_current(machine, y, velocity), _under_full_current(machine, -y, -velocity))


def _under_full_current(machine: Machine, y: float, velocity: float) -> float:
    """Largest y in m under i_c = −I0, until the platform is at the other stop or beyond this one."""
    period_ns = round(1e9 / machine.stage.rate)
    delay_ns = round(machine.stage.drive.delay * period_ns)
    bias, stop = machine.plant.actuator.bias_current, machine.plant.platform.stop
    wide = _beyond_its_stop(machine).plant
    constants = as_array(wide.constants())
    state = np.array(PlantState(y=y, velocity=velocity, bias=bias))
    largest, asked = y, 0.0
    for _ in range(round(_FULL_CURRENT_FOR * machine.stage.rate)):
        if not -stop < state[0] < wide.platform.stop:
            break
        advance(constants, state, bias, asked, delay_ns, -bias, period_ns - delay_ns)
        asked = -bias
        largest = max(largest, float(state[0]))
    return largest


def peak(machine: Machine, y: float, velocity: float = 0.0) -> float:
    """Largest |y| in m on the way to rest at the centre; infinite if the law does not bring the platform there.

    The start is a blow: at the first sample the law knows of a platform at rest at ``y``, and learns its velocity from
    the readings that follow. The bias current is on, the control current zero. The mechanical stop is out of the way:
    the platform recovers if it does not come to where the stop is.

    Args:
        machine: plant, law and its limit of the current, sampling.
        y: m.
        velocity: m/s.
    """
    true_y = response(machine, y, velocity)
    return float(np.abs(true_y).max()) if settling_time(machine, true_y) < math.inf else math.inf


def recovers(machine: Machine, y: float) -> bool:
    """Whether the law brings a platform at rest at ``y`` in m to rest at the centre, without its touching a stop."""
    return peak(machine, y) < machine.plant.platform.stop


def settling_time(machine: Machine, true_y: NDArray[np.float64]) -> float:
    """Time in s after which |y| of a :func:`response` stays within `RETURNED` y0; infinite if there is none."""
    if true_y.size < _samples(machine):
        return math.inf
    outside = np.flatnonzero(np.abs(true_y) >= RETURNED * machine.plant.actuator.air_gap)
    settled = float(outside[-1] + 1) / machine.stage.rate if outside.size else 0.0
    return settled if settled <= _DURATION - _HELD else math.inf


def response(machine: Machine, y: float, velocity: float = 0.0) -> NDArray[np.float64]:
    """True y (n,) in m at the samples after a start at ``y`` in m with ``velocity`` in m/s, the stop out of the way.

    Shorter than the others if the law's current is not finite.
    """
    count = _samples(machine)
    period_ns = round(1e9 / machine.stage.rate)
    conditions = Conditions(
        stamps=np.arange(count) * period_ns,
        delays=np.full(count, round(machine.stage.drive.delay * period_ns)),
        references=np.zeros((count, 3)),
        noise=np.zeros(count),
    )
    initial = PlantState(y=y, velocity=velocity, bias=machine.plant.actuator.bias_current)
    law = make_law(machine.control, machine.stage)
    return run_cycle(law, _beyond_its_stop(machine).plant, conditions, initial).true_y


def largest_release(machine: Machine, steps: int = 8) -> float:
    """Largest y in m from which a platform at rest recovers, by bisection between the centre and the stop."""
    return largest(lambda y: recovers(machine, y), 0.0, machine.plant.platform.stop, steps)


def _samples(machine: Machine) -> int:
    return round(_DURATION * machine.stage.rate)


def _beyond_its_stop(machine: Machine) -> Machine:
    gap = machine.plant.actuator.air_gap
    wide = max(machine.plant.platform.stop, _BESIDE_STOP * gap)
    return dataclasses.replace(
        machine,
        plant=dataclasses.replace(machine.plant, platform=dataclasses.replace(machine.plant.platform, stop=wide)),
    )
