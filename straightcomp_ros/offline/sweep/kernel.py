"""One cycle of the stage as a compiled loop: the law's own step function against the plant's own, sample by sample.

It gives, bit for bit, what :class:`straightcomp_ros.offline.simulation.Simulation` gives under the same conditions,
some ten times faster. References are computed beforehand, since the stage's motion does not depend on the platform.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.law import Law
from straightcomp_ros.hardware.simulated import SimulatedParameters
from straightcomp_ros.model.commanded_plant import BIAS, READING, Hold, advance_to_sample, commanded_plant
from straightcomp_ros.model.compiled import compiled
from straightcomp_ros.model.plant import PlantParameters, PlantState

_SHIPPED_HOLD = SimulatedParameters().hold
_compiling = threading.Lock()
_kernels: dict[Callable[..., Any], Callable[..., int]] = {}


@dataclass(frozen=True, eq=False)
class Conditions:
    """What one cycle runs under, apart from plant and law; all arrays (n,), sample k of each belonging together.

    Attributes:
        stamps: time of each sample in ns, int64; the first is 0, and they rise.
        delays: time from each sample until its command takes effect, in ns, int64, zero or more. A command never
            overtakes the one before: it then takes effect together with it, and replaces it.
        references: (n, 3) r in m, ṙ in m/s, r̈ in m/s² that the law is given.
        noise: what the encoder of y adds to the position before it rounds, m.
    """

    stamps: NDArray[np.int64]
    delays: NDArray[np.int64]
    references: NDArray[np.float64]
    noise: NDArray[np.float64]


class Cycle(NamedTuple):
    """What happened; (samples,) each: true y and y as the encoder saw it in m, control current commanded in A.

    Shorter than its conditions if the law gave a current that is not finite, or the platform's position was not.
    """

    true_y: NDArray[np.float64]
    y: NDArray[np.float64]
    current: NDArray[np.float64]


def run_cycle(
    law: Law, plant: PlantParameters, conditions: Conditions, initial_y: float = 0.0, hold: Hold = _SHIPPED_HOLD
) -> Cycle:
    """Run one cycle with the amplifier on from the first sample, as `Simulation` does.

    Args:
        law: the law; its functions must be `compilable`.
        plant: the machine.
        conditions: of the cycle.
        initial_y: the platform's position at the start, m; it is at rest there.
        hold: what the board does when the next command is late.
    """
    return run_from(law, plant, conditions, PlantState(y=initial_y), hold)


def run_from(
    law: Law, plant: PlantParameters, conditions: Conditions, initial: PlantState, hold: Hold = _SHIPPED_HOLD
) -> Cycle:
    """As :func:`run_cycle`, from any state of the plant (its forces are not read).

    The law starts anew, at rest at its first reading; like the amplifier's and the board's, the time limits of the
    Servo for late commands and lost samples are not modelled.
    """
    count = conditions.stamps.size
    true_y, y, current = np.empty(count), np.empty(count), np.empty(count)
    first = plant.encoder.reading(initial.y + float(conditions.noise[0]))
    machine = commanded_plant(plant, hold, initial)
    machine.state[BIAS] = plant.actuator.bias_current
    done = kernel(law.function)(
        *machine,
        conditions.stamps,
        np.maximum.accumulate(conditions.stamps + conditions.delays),
        conditions.references,
        conditions.noise,
        law.gains,
        law.start(first),
        true_y,
        y,
        current,
    )
    return Cycle(true_y[:done], y[:done], current[:done])


def kernel(step: Callable[..., Any]) -> Callable[..., int]:
    """The compiled loop around a law's step function: compiled once in a process, and kept on disk."""
    with _compiling:
        if step not in _kernels:
            _kernels[step] = compiled(_loop_around(step))
        return _kernels[step]


def _loop_around(step: Callable[..., Any]) -> Callable[..., int]:
    def loop(  # type: ignore[no-untyped-def]
        constants, state, times, stamps, effective, references, noise, gains, law_state, true_y, y, current
    ):
        """Samples done."""
        taken = 0
        for k in range(stamps.size):
            waiting, asked = effective[taken:], current[taken:]
            taken += advance_to_sample(constants, state, times, waiting, asked, k - taken, stamps[k], noise[k])
            if not math.isfinite(state[0]):
                return k
            true_y[k], y[k] = state[0], state[READING]
            law_state, answer = step(
                gains, law_state, y[k], references[k, 0], references[k, 1], references[k, 2], state[3]
            )
            if not math.isfinite(answer.current):
                return k
            current[k] = answer.current
        return stamps.size

    return loop
