"""Least squares on the prediction errors of a record, under one assumption about what the model misses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from straightcomp_ros.identification.current_path import CurrentPath
from straightcomp_ros.identification.predictor import filter_gains, prediction_errors
from straightcomp_ros.identification.stretch import Recording
from straightcomp_ros.identification.unknowns import Unknowns

Array = NDArray[np.float64]

PRIOR = np.log(10.0)
"""Standard deviation, in logarithms, of a prior around the start: it only keeps what the record does not tell."""
BURN_IN = 100
"""Samples in which the first state is still being found."""
_STEP = 3e-3
_ROUNDS = 3
_SETTLED = 5e-3
_OUTLIER = 1e3


@dataclass(frozen=True, eq=False)
class Level:
    """Answer under one assumption: vector, Jacobian and residuals (in standard deviations) there."""

    vector: Array
    jacobian: Array
    residuals: Array
    missed: float

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.residuals**2)))


class Search:
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
        return np.clip(np.nan_to_num(errors[BURN_IN:], nan=_OUTLIER), -_OUTLIER, _OUTLIER)

    def solve(self, start: Array, missed: float) -> Level:
        """Least squares under one assumption; the gains follow the answer."""
        vector, free = start, self._free
        low, high = self._unknowns.low[free], self._unknowns.high[free]
        for _ in range(_ROUNDS):
            self.take_gains(vector, missed)
            found = least_squares(
                lambda z: np.concatenate([self.residuals(self._whole(z)), self._away(z)]),
                np.clip(vector[free], low + 1e-6, high - 1e-6),
                jac=lambda z: np.concatenate([self.jacobian(z), np.eye(len(z)) / PRIOR]),
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
        return Level(vector, found.jac[: -len(free)], found.fun[: -len(free)], missed)

    def jacobian(self, free: Array) -> Array:
        """Derivatives (n − burn-in, free) of the residuals by the free logarithms, by differences."""
        here = self.residuals(self._whole(free))
        return np.stack([(self.residuals(self._whole(free + step)) - here) / _STEP for step in self._steps], axis=1)

    def _whole(self, free: Array) -> Array:
        vector = self._unknowns.start.copy()
        vector[self._free] = free
        return vector

    def _away(self, free: Array) -> Array:
        return np.asarray((free - self._unknowns.start[self._free]) / PRIOR)
