"""The search for the unknowns: least squares on the errors of one-step-ahead predictions by the plant's own model.

**Prediction.** An extended Kalman filter with the state position, velocity and bristle deflection. A simulation from
the first sample alone would leave the recorded path within 10 ms: the magnets' pole is unstable at +100 rad/s, and
where friction falls with velocity the growth is up to some 1000 /s. Windows with free initial states (multiple
shooting) would have to be shorter than the settling time of a bristle, so that each window's unknown bristle would
absorb what is to be learnt. The filter carries the bristle through the whole record, and each sample corrects the path
by its weight: in sliding the bristle is known from the model, at rest from the position. The gains depend on the
parameters; the derivatives hold them constant, which makes the prediction error a smooth, stable function of the
parameters (prediction error method: L. Ljung, System Identification, 2nd ed., 1999, chapters 3 and 7).

**Process noise**, the model's error from sample to sample, is unknown. Assuming much of it makes the search robust but
biased: samples then outweigh the model, and mass and friction come out too small. Assuming little removes the bias, but
far from the solution the prediction loses the path. The search therefore starts with much, with still more where even
that loses the path, and reduces it while the prediction errors agree with their standard deviation. The last moves of
the solution, to it and, if the next step failed, from it, bound the remaining bias and enter the confidence intervals,
as does what the least squares left: in a flat valley that is more than rounding.

**Starts.** The search begins at the description and where sliding alone leads (`unknowns.py`), and goes on from
the likelier of the two solutions. If that does not hold with the least process noise, it goes on from the other one
too, and the one that holds with less is taken: one start alone may end in a valley that explains the record and is
wrong.
"""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from straightcomp_ros.analysis import IdentificationError
from straightcomp_ros.analysis.current_path import CurrentPath, Recording
from straightcomp_ros.model.compiled import compilable, compiled, compiled_for_threads
from straightcomp_ros.model.plant import advance
from straightcomp_ros.straightness.residual import rms
from straightcomp_ros.tuning.identification.unknowns import BLOCK, Unknowns, block_covariance, sliding_start

Array = NDArray[np.float64]

MISSED = (1e-5, 3e-6, 1e-6, 3e-7, 1e-7, 3e-8, 1e-8, 3e-9)
"""Assumed standard deviations of the process noise in velocity, m/s (and a thousandth of them in m)."""
_LEAST_MISSED, _LEAST_COUNTS = 3e-7, 1.2e-3
"""The least of them in m/s and, with an encoder of y so fine that it shows less, in counts per sample's period."""
_MORE = (1e-4, 3e-5)
"""The same where the search is lost under the first of them, as on a platform whose modes ring in the record."""
EXPLAINED = 1.03
"""RMS of the prediction errors, in their standard deviations, up to which the assumption holds."""
_LOST = 1.5
"""The same, from which the search has failed."""
PRIOR = np.log(10.0)
"""Standard deviation, in logarithms, of a weak prior around the start, for what the record does not determine."""
BURN_IN = 100
"""Samples until the first state is found."""
_STEP = 3e-3
_ROUNDS = 3
_SETTLED = 5e-3
_LEFT = 0.1
"""Change of the residuals' sum of squares at which least squares ends: a standard deviation changes it by 1."""
_OUTLIER = 1e3


START_DEVIATIONS = (1e-7, 1e-4, 1e-6)
"""Standard deviations of the unknown first state: m, m/s, m."""
_STEPS = (1e-10, 1e-8, 1e-10)


class Record(NamedTuple):
    """A record as the compiled functions take it."""

    bias: float  # bias current, A
    y: Array  # (n,) measured position, m
    current: Array  # (n,) measured coil current, A
    before: Array  # (n,) of the current path, as the next two
    after: Array
    switch_ns: NDArray[np.int64]
    period_ns: int


@compilable
def _advance_sample(constants: Array, state: Array, record: Record, k: int) -> None:
    """Advance ``state`` from sample k to the next."""
    first_ns = record.switch_ns[k]
    advance(constants, state, record.bias, record.before[k], first_ns, record.after[k], record.period_ns - first_ns)


@compiled
def filter_gains(constants: Array, record: Record, deviations: Array, gains: Array) -> None:
    """Run the filter once with the plant's ``constants``, the amplifier's being that of the current path.

    Args:
        deviations: (3,) standard deviations of a reading in m, and of the process noise per sample in velocity (m/s)
            and bristle (m).
        gains: (n, 4), filled: corrections of the three states per m of prediction error, and one over the prediction
            error's standard deviation in 1/m.
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
    """Fill ``errors`` (n,) with the filter's prediction errors in their standard deviations, with these ``gains``."""
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


@dataclass(frozen=True, eq=False)
class Level:
    """Solution under one assumption: vector, and Jacobian and residuals (in standard deviations) there.

    ``surprise`` is minus twice the logarithm of the record's likelihood, but for a constant (L. Ljung, System
    Identification, 2nd ed., 1999, section 7.4). It compares solutions that have gains of their own.
    """

    vector: Array
    jacobian: Array
    residuals: Array
    missed: float
    surprise: float

    @property
    def rms(self) -> float:
        return rms(self.residuals)


class Search:
    """Least squares on the prediction errors of a record."""

    def __init__(self, recording: Recording, path: CurrentPath, unknowns: Unknowns, resolution: float) -> None:
        self._unknowns, self._rate = unknowns, path.rate
        samples = (recording.y, recording.current, path.before, path.after, path.switch_ns)
        self._record = Record(unknowns.stage.actuator.bias_current, *samples, recording.period_ns)
        self._noise = resolution / np.sqrt(12.0)
        self._free = unknowns.free
        self._steps = _STEP * np.eye(len(self._free))
        self.gains = np.empty((len(recording.y), 4))

    def take_gains(self, vector: Array, missed: float) -> None:
        """Run the filter at ``vector``, and keep its gains."""
        deviations = np.array([self._noise, missed, 1e-3 * missed])
        filter_gains(self._unknowns.constants(vector, self._rate), self._record, deviations, self.gains)

    def residuals(self, vector: Array) -> Array:
        """Prediction errors (n − burn-in,) in standard deviations, with the present gains."""
        errors = np.empty(len(self.gains))
        prediction_errors(self._unknowns.constants(vector, self._rate), self._record, self.gains, errors)
        # How far a prediction left the path does not matter.
        return np.clip(np.nan_to_num(errors[BURN_IN:], nan=_OUTLIER), -_OUTLIER, _OUTLIER)

    def solve(self, start: Array, missed: float) -> Level:
        """Least squares under one assumption; the gains follow the solution."""
        vector, free = start, self._free
        origin, low, high = (bound[free] for bound in (self._unknowns.start, self._unknowns.low, self._unknowns.high))
        for _ in range(_ROUNDS):
            self.take_gains(vector, missed)
            # Derivatives are asked for where the residuals have just been.
            here = lru_cache(maxsize=1)(lambda z: self.residuals(self._whole(np.frombuffer(z))))
            found = least_squares(
                lambda z, here=here: np.concatenate([here(z.tobytes()), (z - origin) / PRIOR]),
                np.clip(vector[free], low + 1e-6, high - 1e-6),
                jac=lambda z, here=here: np.concatenate([self.jacobian(z, here(z.tobytes())), np.eye(len(z)) / PRIOR]),
                bounds=(low, high),
                x_scale=0.3,
                # In a flat valley a loose end depends on the last bits: by far less than a standard deviation.
                ftol=_LEFT / len(self.gains),
                xtol=1e-4,
                max_nfev=20,
            )
            moved = float(np.abs(found.x - vector[free]).max())
            vector = self._whole(found.x)
            if moved < _SETTLED:
                break
        residuals = found.fun[: -len(free)]
        surprise = float(residuals @ residuals - 2.0 * np.log(self.gains[BURN_IN:, 3]).sum())
        return Level(vector, found.jac[: -len(free)], residuals, missed, surprise)

    def jacobian(self, free: Array, here: Array) -> Array:
        """Derivatives (n − burn-in, free) of the residuals, ``here`` (n − burn-in,), by the free logarithms, by
        differences."""
        vectors = [self._whole(free + step) for step in self._steps]
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as threads:
            moved = threads.map(self.residuals, vectors)
        return np.stack([(there - here) / _STEP for there in moved], axis=1)

    def onward(self, level: Level) -> Array:
        """Where one more step of Gauss and Newton would lead from a solution, within the bounds."""
        unknowns, free = self._unknowns, self._free
        weak = np.eye(len(free)) / PRIOR
        missed = np.concatenate([level.residuals, weak @ (level.vector[free] - unknowns.start[free])])
        step = np.linalg.lstsq(np.vstack([level.jacobian, weak]), missed, rcond=None)[0]
        return self._whole(np.clip(level.vector[free] - step, unknowns.low[free], unknowns.high[free]))

    def _whole(self, free: Array) -> Array:
        vector = self._unknowns.start.copy()
        vector[self._free] = free
        return vector


@dataclass(frozen=True, eq=False)
class Fit:
    """What the search found, in the order of the unknowns' vector."""

    solution: Level  # with the least process noise that holds
    covariance: Array  # (free, free) of the free logarithms by the spread of the prediction errors, block by block
    pulls: Array  # (2 or 3, free) moves of the solution to this assumption, what is left of it, and to one that failed
    rms_error_m: float  # prediction errors in m


def levels(resolution: float, period: float) -> list[float]:
    """The assumptions that are tried, for an encoder of this ``resolution`` in m."""
    least = min(_LEAST_MISSED, _LEAST_COUNTS * resolution / period)
    return [*_MORE, *(missed for missed in MISSED if missed >= least)]


def fit(
    recording: Recording,
    path: CurrentPath,
    unknowns: Unknowns,
    resolution: float,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Fit:
    """Find the unknowns from a record, its current between the samples, and the platform's encoder ``resolution`` in m.

    Raises:
        IdentificationError: the prediction loses the path under every assumption.
    """
    search, slid = Search(recording, path, unknowns, resolution), sliding_start(recording, unknowns)
    begins = [unknowns.start] if slid is None else [unknowns.start, slid]
    last, neighbours = solved(search.solve, begins, levels(resolution, recording.period_ns * 1e-9), progress)
    progress(1.0)
    if last.rms > _LOST:
        raise IdentificationError(
            f"the model does not explain the record: prediction errors are {last.rms:.1f} times what they should be; "
            "record with more excitation, or start nearer to the machine (--params-file, --set); check encoder "
            "resolution, bias current and pole area there"
        )
    search.take_gains(last.vector, last.missed)
    errors = search.residuals(last.vector) / search.gains[BURN_IN:, 3]
    block = max(1, round(BLOCK / (recording.period_ns * 1e-9)))
    return Fit(
        solution=last,
        covariance=block_covariance(last.jacobian, last.residuals, block, float(PRIOR)),
        pulls=np.array(
            [last.vector[unknowns.free] - other[unknowns.free] for other in (*neighbours, search.onward(last))]
        ),
        rms_error_m=rms(errors),
    )


def solved(
    solve: Callable[[Array, float], Level],
    begins: Sequence[Array],
    assumed: Sequence[float],
    progress: Callable[[float], None] = lambda fraction: None,
) -> tuple[Level, list[Array]]:
    """The solution with the least process noise that holds, and its neighbours: the solution that its search began
    with, and the next one if that hardly failed; the description where neither is known.

    ``solve`` finds one from a vector under an assumption; ``begins`` are the description and perhaps another vector,
    ``assumed`` the assumptions, largest first.
    """
    for most in (MISSED[0], _MORE[0]):
        solutions = sorted((solve(begin, most) for begin in begins), key=lambda level: level.surprise)
        if solutions[0].rms <= _LOST:
            break
    found = _followed(solve, solutions[0], assumed, progress)
    if found[0].missed > assumed[-1] and len(solutions) > 1:
        found = min(found, _followed(solve, solutions[1], assumed, progress), key=lambda one: one[0].missed)
    return found[0], found[1] or [begins[0]]


def _followed(
    solve: Callable[[Array, float], Level], first: Level, assumed: Sequence[float], progress: Callable[[float], None]
) -> tuple[Level, list[Array]]:
    """What :func:`solved` returns, from the solution ``first`` on, without the description."""
    last, begin = first, first.vector
    before, after = list[Array](), list[Array]()
    less = [missed for missed in assumed if missed < first.missed]
    for number, missed in enumerate(less, 1):
        progress(number / (len(less) + 1))
        level = solve(begin, missed)
        if level.rms <= max(EXPLAINED, last.rms):
            last, before, after = level, [begin], []
        elif not after and level.rms < _LOST:
            after = [level.vector]
        # One that hardly failed may be nearer to the next one than the last that held.
        begin = level.vector if level.rms < _LOST else last.vector
    return last, [*before, *after]
