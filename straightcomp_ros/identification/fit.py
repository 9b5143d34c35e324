"""The search for the unknowns: least squares on prediction errors, sharpened step by step.

How much the model misses from sample to sample is not known. Assuming much makes the search well behaved, but pulls the
answer: each sample then counts for more than the model, and mass and friction come out too small. Assuming little
removes the pull, but far from the answer the prediction loses the path. So the search starts with much and goes down,
as far as the prediction errors stay as small as their own standard deviation says. The last move of the answer tells
how much pull may be left, and enters the confidence intervals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from straightcomp_ros.identification import IdentificationError
from straightcomp_ros.identification.current_path import CurrentPath
from straightcomp_ros.identification.predictor import filter_gains, prediction_errors
from straightcomp_ros.identification.recording import Recording
from straightcomp_ros.identification.unknowns import Unknowns

Array = NDArray[np.float64]

MISSED = (1e-5, 3e-6, 1e-6, 3e-7)
"""What the model is assumed to miss in velocity from sample to sample, m/s (and a thousandth of it in m)."""
EXPLAINED = 1.15
"""RMS of the prediction errors, in their standard deviations, up to which the assumption holds."""
_PRIOR = np.log(10.0)
"""Standard deviation, in logarithms, of a prior around the start: it only keeps what the record does not tell."""
_BURN_IN = 100
"""Samples in which the first state is still being found."""
_STEP = 3e-3
_ROUNDS = 3
_SETTLED = 5e-3
_OUTLIER = 1e3
_BLOCK = 0.25
"""Length in s of the blocks that count as independent: quantisation errors are alike for up to some 0.1 s."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Answer of the search, in the order of the unknowns' vector.

    Attributes:
        vector: (9,) logarithms.
        covariance: (free, free) of the free logarithms by the spread of the prediction errors, block by block.
        pull: (free,) last move of the answer, as the assumption about what the model misses was sharpened.
        missed: that assumption in m/s at the answer.
        rms_error: prediction errors in their standard deviations; about 1 where the model explains the record.
        rms_error_m: prediction errors in m.
        evaluations: predictions of the whole record.
    """

    vector: Array
    covariance: Array
    pull: Array
    missed: float
    rms_error: float
    rms_error_m: float
    evaluations: int


@dataclass(frozen=True, eq=False)
class _Level:
    """Answer under one assumption: vector, Jacobian and residuals (in standard deviations) there."""

    vector: Array
    jacobian: Array
    residuals: Array
    missed: float

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.residuals**2)))


class _Search:
    """The record and what is looked for in it."""

    def __init__(self, recording: Recording, path: CurrentPath, unknowns: Unknowns, resolution: float) -> None:
        self._unknowns, self._rate = unknowns, path.rate
        self._record = (
            unknowns.bias_current,
            recording.y,
            recording.current,
            path.before,
            path.after,
            path.switch_ns,
            recording.period_ns,
        )
        self._noise = resolution / np.sqrt(12.0)
        self._free = list(unknowns.free)
        self._steps = _STEP * np.eye(len(self._free))
        self.gains = np.empty((len(recording.y), 4))
        self.evaluations = 0

    def take_gains(self, vector: Array, missed: float) -> None:
        """Run the filter at ``vector``: its gains hold from now on."""
        errors = np.empty(len(self.gains))
        deviations = np.array([self._noise, missed, 1e-3 * missed])
        filter_gains(self._unknowns.constants(vector, self._rate), *self._record, deviations, self.gains, errors)
        self.evaluations += 4

    def residuals(self, vector: Array) -> Array:
        """Prediction errors (n − burn-in,) in standard deviations, with the gains that hold."""
        errors = np.empty(len(self.gains))
        prediction_errors(self._unknowns.constants(vector, self._rate), *self._record, self.gains, errors)
        self.evaluations += 1
        # A prediction that left the path by far says no more than that it did.
        return np.clip(np.nan_to_num(errors[_BURN_IN:], nan=_OUTLIER), -_OUTLIER, _OUTLIER)

    def solve(self, start: Array, missed: float) -> _Level:
        """Least squares under one assumption; the gains follow the answer."""
        vector, free = start, self._free
        low, high = self._unknowns.low[free], self._unknowns.high[free]
        for _ in range(_ROUNDS):
            self.take_gains(vector, missed)
            found = least_squares(
                lambda z: np.concatenate([self.residuals(self._whole(z)), self._away(z)]),
                np.clip(vector[free], low + 1e-6, high - 1e-6),
                jac=lambda z: np.concatenate([self.jacobian(z), np.eye(len(z)) / _PRIOR]),
                bounds=(low, high),
                x_scale=0.3,
                ftol=1e-3,
                xtol=1e-3,
                max_nfev=8,
            )
            moved = float(np.abs(found.x - vector[free]).max())
            vector = self._whole(found.x)
            if moved < _SETTLED:
                break
        return _Level(vector, found.jac[: -len(free)], found.fun[: -len(free)], missed)

    def jacobian(self, free: Array) -> Array:
        """Derivatives (n − burn-in, free) of the residuals by the free logarithms, by differences."""
        here = self.residuals(self._whole(free))
        return np.stack([(self.residuals(self._whole(free + step)) - here) / _STEP for step in self._steps], axis=1)

    def _whole(self, free: Array) -> Array:
        vector = self._unknowns.start.copy()
        vector[self._free] = free
        return vector

    def _away(self, free: Array) -> Array:
        return np.asarray((free - self._unknowns.start[self._free]) / _PRIOR)


def fit(
    recording: Recording,
    path: CurrentPath,
    unknowns: Unknowns,
    resolution: float,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Fit:
    """Find the unknowns.

    Args:
        recording, path: what was recorded.
        unknowns: what to look for, and where to start.
        resolution: of the platform's encoder, m.
        progress: called with the fraction that is done.

    Raises:
        IdentificationError: the prediction loses the path under every assumption.
    """
    search = _Search(recording, path, unknowns, resolution)
    levels = [search.solve(unknowns.start, MISSED[0])]
    for number, missed in enumerate(MISSED[1:], 1):
        progress(number / len(MISSED))
        level = search.solve(levels[-1].vector, missed)
        if level.rms > EXPLAINED * max(1.0, levels[-1].rms):
            break
        levels.append(level)
    progress(1.0)
    last = levels[-1]
    if last.rms > 3.0:
        raise IdentificationError(
            f"the model does not explain the record: prediction errors are {last.rms:.1f} times what they should be; "
            "check encoder resolution, bias current and pole area in the parameters, and start nearer to the machine"
        )
    free = list(unknowns.free)
    before = levels[-2].vector if len(levels) > 1 else unknowns.start
    search.take_gains(last.vector, last.missed)
    errors = search.residuals(last.vector) / search.gains[_BURN_IN:, 3]
    block = max(1, round(_BLOCK / (recording.period_ns * 1e-9)))
    return Fit(
        vector=last.vector,
        covariance=_covariance(last.jacobian, last.residuals, block),
        pull=(last.vector - before)[free],
        missed=last.missed,
        rms_error=last.rms,
        rms_error_m=float(np.sqrt(np.mean(errors**2))),
        evaluations=search.evaluations,
    )


def _covariance(jacobian: Array, residuals: Array, block: int) -> Array:
    """(free, free): (JᵀJ)⁻¹ (Σ s sᵀ) (JᵀJ)⁻¹ with s = Jᵀr of each block, so that errors may be alike within a block.

    What the record does not tell at all gets a variance of the size of the prior's: the inverse holds it.
    """
    information = jacobian.T @ jacobian
    inverse = np.linalg.inv(information + np.eye(len(information)) / _PRIOR**2)
    count = len(residuals) // block
    used = slice(0, count * block)
    scores = (jacobian[used] * residuals[used, None]).reshape(count, block, -1).sum(axis=1)
    spread = inverse @ (scores.T @ scores) @ inverse * count / max(1, count - len(information))
    # The prior's own part: near zero where the record tells the parameter.
    return np.asarray(spread + inverse @ inverse / _PRIOR**2)
