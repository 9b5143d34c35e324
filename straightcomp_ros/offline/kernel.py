"""One cycle of the stage as a compiled loop over the law's own step function and the plant's own.

It gives, bit for bit, what :class:`straightcomp_ros.offline.simulation.Simulation` gives under the same conditions,
some ten times faster. References are computed beforehand, since the stage's motion does not depend on the platform.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.law import Law
from straightcomp_ros.hardware.simulated import SimulatedParameters
from straightcomp_ros.model.compiled import compiled
from straightcomp_ros.model.plant import (
    BIAS,
    PLACE,
    READING,
    Hold,
    PlantParameters,
    PlantState,
    advance_to_sample,
    commanded_plant,
)
from straightcomp_ros.stage.description import StageParameters

_SHIPPED_HOLD = SimulatedParameters().hold(StageParameters())
_AT_REST = PlantState()
_compiling = threading.Lock()
_kernels: dict[Callable[..., Any], Callable[..., int]] = {}


@dataclass(frozen=True, eq=False)
class Conditions:
    """Conditions of one cycle, apart from plant and law; all arrays (n,), one entry for each sample.

    Attributes:
        stamps: time of each sample in ns, int64; the first is 0, and they rise.
        delays: time from each sample until its command takes effect, in ns, int64, zero or more. A command never
            overtakes the one before: it then takes effect together with it, and replaces it.
        references: (n, 3) r in m, ṙ in m/s, r̈ in m/s² for the law.
        noise: added to the position y before the encoder rounds, m.
        x: true position of the stage in m, which only disturbances ask for; by default it stays at 0.
    """

    stamps: NDArray[np.int64]
    delays: NDArray[np.int64]
    references: NDArray[np.float64]
    noise: NDArray[np.float64]
    x: NDArray[np.float64] | None = None


class Cycle(NamedTuple):
    """True y and the encoder's y in m, and the commanded control current in A, (samples,) each.

    Shorter than its conditions if a current of the law or the platform's position was not finite.
    """

    true_y: NDArray[np.float64]
    y: NDArray[np.float64]
    current: NDArray[np.float64]


def run_cycle(
    law: Law,
    plant: PlantParameters,
    conditions: Conditions,
    initial: PlantState = _AT_REST,
    hold: Hold = _SHIPPED_HOLD,
) -> Cycle:
    """Run one cycle with the amplifier on from the first sample, as `Simulation` does.

    The law starts at rest at its first reading. The time limits of amplifier, board and `Servo` for late commands and
    lost samples are not modelled.

    The law's functions must be `compilable`. Of the plant's ``initial`` state the forces are not read; ``hold`` is how
    the board holds the platform when the next command is late.
    """
    count = conditions.stamps.size
    true_y, y, current = np.empty(count), np.empty(count), np.empty(count)
    machine = commanded_plant(plant, hold, initial)
    machine.state[BIAS] = plant.actuator.bias_current
    x = np.zeros(count) if conditions.x is None else conditions.x
    # At the first sample nothing has moved yet: this reading is the one that the loop takes again.
    advance_to_sample(*machine, conditions.stamps[:0], current[:0], 0, 0, conditions.noise[0], x[0])
    first = float(machine.state[READING])
    done = kernel(law.function)(
        *machine,
        conditions.stamps,
        np.maximum.accumulate(conditions.stamps + conditions.delays),
        conditions.references,
        conditions.noise,
        x,
        law.gains,
        law.start(first),
        true_y,
        y,
        current,
    )
    return Cycle(true_y[:done], y[:done], current[:done])


def kernel(step: Callable[..., Any]) -> Callable[..., int]:
    """The compiled loop around a law's step function, compiled once in a process and cached on disk."""
    with _compiling:
        if step not in _kernels:
            _kernels[step] = compiled(_loop_around(step))
        return _kernels[step]


def _loop_around(step: Callable[..., Any]) -> Callable[..., int]:
    def loop(  # type: ignore[no-untyped-def]
        constants, state, times, stamps, effective, references, noise, x, gains, law_state, true_y, y, current
    ):
        """Samples done."""
        taken = 0
        for k in range(stamps.size):
            waiting, asked = effective[taken:], current[taken:]
            taken += advance_to_sample(constants, state, times, waiting, asked, k - taken, stamps[k], noise[k], x[k])
            if not math.isfinite(state[0]):
                return k
            true_y[k], y[k] = state[PLACE], state[READING]
            law_state, answer = step(
                gains, law_state, y[k], references[k, 0], references[k, 1], references[k, 2], state[3]
            )
            if not math.isfinite(answer.current):
                return k
            current[k] = answer.current
        return stamps.size

    return loop
