"""The sampled loop on its own: any initial position, any reference over time, no guide and no map."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.laws import make_law
from straightcomp_ros.model.plant import PlantState, advance, as_array
from straightcomp_ros.tuning.paper.ideal_machine import Machine


@dataclass(frozen=True, eq=False)
class Response:
    """What the loop did; all arrays (n,), sample k of each at the same time.

    Attributes:
        time: s from the release.
        reference: r, m.
        reading: y as the encoder sees it, m.
        y: true position, m.
        velocity: true ẏ, m/s.
        coil_current: control current in the coils, A.
        friction: force of friction, N, positive where it resists a positive velocity.
        command: i_c asked by the law, A.
        sigma: sliding variable as the law computes it, m/s.
    """

    time: NDArray[np.float64]
    reference: NDArray[np.float64]
    reading: NDArray[np.float64]
    y: NDArray[np.float64]
    velocity: NDArray[np.float64]
    coil_current: NDArray[np.float64]
    friction: NDArray[np.float64]
    command: NDArray[np.float64]
    sigma: NDArray[np.float64]


def hold_still(machine: Machine, duration: float) -> NDArray[np.float64]:
    """A reference of zero for ``duration`` in s, (n,) in m."""
    return np.zeros(round(duration * machine.stage.rate))


def largest(returns: Callable[[float], bool], low: float, high: float, steps: int) -> float:
    """Largest value between ``low`` and ``high`` that ``returns``, by bisection to 1 / 2^steps of the interval."""
    for _ in range(steps):
        middle = 0.5 * (low + high)
        if returns(middle):
            low = middle
        else:
            high = middle
    return low


def release(machine: Machine, initial_y: float, reference: NDArray[np.float64]) -> Response:
    """Release the platform at rest at ``initial_y``, bias current on, control current zero, and run the loop.

    The law is told r and no rates of it, as the paper's is.

    Args:
        machine: plant, law and sampling.
        initial_y: m, inside the stops.
        reference: (n,) in m, one value for each sample.
    """
    period_ns = round(1e9 / machine.stage.rate)
    delay_ns = round(machine.stage.drive.delay * period_ns)
    constants = as_array(machine.plant.constants())
    bias = machine.plant.actuator.bias_current
    state = np.array(PlantState(y=initial_y, bias=bias))
    reading, converted = machine.plant.encoder.y_reading, machine.plant.drive.converted
    law = make_law(machine.control, machine.stage)
    law.reset(reading(initial_y))
    applied = 0.0
    rows = np.empty((len(reference), 7))
    for index, r in enumerate(reference.tolist()):
        y, velocity, _, control, _, friction, *_ = state.tolist()
        seen = reading(y)
        command = law.step(seen, r, 0.0, 0.0)
        rows[index] = seen, y, velocity, control, friction, command.current, command.sliding_variable
        asked = converted(command.current)
        advance(constants, state, bias, applied, delay_ns, asked, period_ns - delay_ns)
        applied = asked
    time = np.arange(len(reference), dtype=np.float64) * (period_ns * 1e-9)
    return Response(time, reference, *rows.T.copy())
