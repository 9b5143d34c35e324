"""One-step-ahead prediction of the recorded position by the plant's own model: an extended Kalman filter.

A simulation from the first sample alone would leave the recorded path within 10 ms: the magnets' pole is unstable at
+100 rad/s, and where friction falls with velocity the growth is up to some 1000 /s. Windows with free initial states
(multiple shooting) would have to be shorter than the settling time of a bristle, so that each window's unknown bristle
would absorb what is to be learnt. The filter carries the bristle through the whole record, and each sample corrects the
path by its weight. The gains depend on the parameters; the derivatives hold them constant, which makes the prediction
error a smooth, stable function of the parameters (prediction error method: L. Ljung, System Identification, 2nd ed.,
1999, chapters 3 and 7).

State: position, velocity, bristle deflection. The bristle is corrected with the position by their covariance: in
sliding it is known from the model, at rest from the position.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.compiled import compilable, compiled, compiled_for_threads
from straightcomp_ros.model.plant import advance

Array = NDArray[np.float64]

START_DEVIATIONS = (1e-7, 1e-4, 1e-6)
"""Standard deviations of the unknown first state: m, m/s, m."""
_STEPS = (1e-10, 1e-8, 1e-10)


class Record(NamedTuple):
    """A record as the compiled functions take it.

    Attributes:
        bias: bias current, A.
        y, current: (n,) measured position in m and coil current in A.
        before, after, switch_ns: (n,) of the current path.
        period_ns: sampling period.
    """

    bias: float
    y: Array
    current: Array
    before: Array
    after: Array
    switch_ns: NDArray[np.int64]
    period_ns: int


@compilable
def _advance_sample(constants: Array, state: Array, record: Record, k: int) -> None:
    """Advance ``state`` from sample k to the next."""
    first_ns = record.switch_ns[k]
    advance(constants, state, record.bias, record.before[k], first_ns, record.after[k], record.period_ns - first_ns)


@compiled
def filter_gains(constants: Array, record: Record, deviations: Array, gains: Array, errors: Array) -> None:
    """Run the filter once.

    Args:
        constants: of the plant, with the amplifier of the current path.
        record: the record.
        deviations: (3,) standard deviations of a reading in m, and of the process noise per sample in velocity (m/s)
            and bristle (m).
        gains: (n, 4), filled: corrections of the three states per m of prediction error, and one over the prediction
            error's standard deviation in 1/m.
        errors: (n,), filled: prediction errors in their standard deviations.
    """
    y = record.y
    state = np.zeros(7)
    state[0], state[4] = y[0], record.bias
    covariance, transition, first = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    for i in range(3):
        covariance[i, i] = START_DEVIATIONS[i] * START_DEVIATIONS[i]
    noise = deviations[0] * deviations[0]
    for k in range(len(y)):
        error = y[k] - state[0]
        variance = covariance[0, 0] + noise
        gains[k, 3] = 1.0 / math.sqrt(variance)
        errors[k] = error * gains[k, 3]
        for i in range(3):
            first[i] = covariance[0, i]
            gains[k, i] = covariance[i, 0] / variance
            state[i] += gains[k, i] * error
        for i in range(3):
            for j in range(3):
                covariance[i, j] -= gains[k, i] * first[j]
        state[3] = record.current[k]
        corrected = state.copy()
        _advance_sample(constants, state, record, k)
        for j in range(3):
            moved = corrected.copy()
            moved[j] += _STEPS[j]
            _advance_sample(constants, moved, record, k)
            for i in range(3):
                transition[i, j] = (moved[i] - state[i]) / _STEPS[j]
        covariance = transition @ covariance @ transition.T
        covariance[1, 1] += deviations[1] * deviations[1]
        covariance[2, 2] += deviations[2] * deviations[2]


@compiled_for_threads
def prediction_errors(constants: Array, record: Record, gains: Array, errors: Array) -> None:
    """Fill ``errors`` as :func:`filter_gains` does, with the given ``gains`` (n, 4)."""
    y = record.y
    state = np.zeros(7)
    state[0], state[4] = y[0], record.bias
    for k in range(len(y)):
        error = y[k] - state[0]
        errors[k] = error * gains[k, 3]
        for i in range(3):
            state[i] += gains[k, i] * error
        state[3] = record.current[k]
        _advance_sample(constants, state, record, k)
