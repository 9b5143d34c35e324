"""One-step-ahead prediction of the recorded position by the plant's own model: an extended Kalman filter.

A simulation from the first sample alone would leave the recorded path within 10 ms: the magnets' pole is unstable at
+100 rad/s, and where friction falls with velocity the growth is up to some 1000 /s. Windows with free initial states
(multiple shooting) would stay on it, but must be shorter than the time in which a bristle settles, so that the unknown
bristle of each window would take up what is to be learnt. A predictor carries the bristle through the whole record, and
each sample puts it back on the path by as much as the sample is worth. The filter's gains depend on the parameters; for
the derivatives they are held, which makes the prediction error a smooth, stable function of the parameters (prediction
error method: L. Ljung, System Identification, 2nd ed., 1999, chapters 3 and 7).

State: position, velocity, bristle deflection. The bristle is corrected with the position by their covariance: in
sliding it is known from the model, at rest from the position.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.compiled import compiled
from straightcomp_ros.model.plant import advance

START_DEVIATIONS = (1e-7, 1e-4, 1e-6)
"""Standard deviations of the unknown first state: m, m/s, m."""
_STEPS = (1e-10, 1e-8, 1e-10)


@compiled
def filter_gains(
    constants: NDArray[np.float64],
    bias: float,
    y: NDArray[np.float64],
    current: NDArray[np.float64],
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    switch_ns: NDArray[np.int64],
    period_ns: int,
    deviations: NDArray[np.float64],
    gains: NDArray[np.float64],
    errors: NDArray[np.float64],
) -> None:
    """Run the filter once; its length is its point.

    Args:
        constants: of the plant, its amplifier as the current path has it.
        bias: bias current, A.
        y, current: (n,) measured position in m and coil current in A.
        before, after, switch_ns: the current path.
        period_ns: sampling period.
        deviations: (3,) standard deviations: of a reading in m, and of what the model misses in velocity (m/s) and in
            the bristle (m) from sample to sample.
        gains: (n, 4), filled: corrections of the three states per m of prediction error, and one over the prediction
            error's standard deviation in 1/m.
        errors: (n,), filled: prediction errors in their standard deviations.
    """
    state = np.zeros(7)
    state[0], state[4] = y[0], bias
    covariance = np.zeros((3, 3))
    for i in range(3):
        covariance[i, i] = START_DEVIATIONS[i] * START_DEVIATIONS[i]
    transition = np.zeros((3, 3))
    first = np.zeros(3)
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
        state[3] = current[k]
        corrected = state.copy()
        advance(constants, state, bias, before[k], switch_ns[k], after[k], period_ns - switch_ns[k])
        for j in range(3):
            moved = corrected.copy()
            moved[j] += _STEPS[j]
            advance(constants, moved, bias, before[k], switch_ns[k], after[k], period_ns - switch_ns[k])
            for i in range(3):
                transition[i, j] = (moved[i] - state[i]) / _STEPS[j]
        covariance = transition @ covariance @ transition.T
        covariance[1, 1] += deviations[1] * deviations[1]
        covariance[2, 2] += deviations[2] * deviations[2]


@compiled
def prediction_errors(
    constants: NDArray[np.float64],
    bias: float,
    y: NDArray[np.float64],
    current: NDArray[np.float64],
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    switch_ns: NDArray[np.int64],
    period_ns: int,
    gains: NDArray[np.float64],
    errors: NDArray[np.float64],
) -> None:
    """Fill ``errors`` as :func:`filter_gains` does, with ``gains`` (n, 4) as given."""
    state = np.zeros(7)
    state[0], state[4] = y[0], bias
    for k in range(len(y)):
        error = y[k] - state[0]
        errors[k] = error * gains[k, 3]
        for i in range(3):
            state[i] += gains[k, i] * error
        state[3] = current[k]
        advance(constants, state, bias, before[k], switch_ns[k], after[k], period_ns - switch_ns[k])
