"""The search for the unknowns: least squares on prediction errors, sharpened step by step.

How much the model misses from sample to sample is not known. Assuming much makes the search well behaved, but pulls the
answer: each sample then counts for more than the model, and mass and friction come out too small. Assuming little
removes the pull, but far from the answer the prediction loses the path. So the search starts with much and goes down,
as far as the prediction errors stay as small as their own standard deviation says. The last moves of the answer, to it
and, where the next step failed, from it, tell how much pull may be left, and enter the confidence intervals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.identification import IdentificationError
from straightcomp_ros.identification.current_path import CurrentPath
from straightcomp_ros.identification.search import BURN_IN, PRIOR, Level, Search
from straightcomp_ros.identification.stretch import Recording
from straightcomp_ros.identification.unknowns import Unknowns

Array = NDArray[np.float64]

MISSED = (1e-5, 3e-6, 1e-6, 3e-7)
"""What the model is assumed to miss in velocity from sample to sample, m/s (and a thousandth of it in m)."""
EXPLAINED = 1.03
"""RMS of the prediction errors, in their standard deviations, up to which the assumption holds."""
_LOST = 1.5
"""The same, from which the search has found nothing."""
_BLOCK = 0.25
"""Length in s of the blocks that count as independent: quantisation errors are alike for up to some 0.1 s."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Answer of the search, in the order of the unknowns' vector.

    Attributes:
        vector: (9,) logarithms.
        covariance: (free, free) of the free logarithms by the spread of the prediction errors, block by block.
        pulls: (1 or 2, free) moves of the answer to this assumption, and to the next one where that failed.
        missed: that assumption in m/s at the answer.
        rms_error: prediction errors in their standard deviations; about 1 where the model explains the record.
        rms_error_m: prediction errors in m.
        evaluations: predictions of the whole record.
    """

    vector: Array
    covariance: Array
    pulls: Array
    missed: float
    rms_error: float
    rms_error_m: float
    evaluations: int


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
    search = Search(recording, path, unknowns, resolution)
    levels = [search.solve(unknowns.start, MISSED[0])]
    failed: list[Level] = []
    for number, missed in enumerate(MISSED[1:], 1):
        progress(number / len(MISSED))
        level = search.solve(levels[-1].vector, missed)
        if level.rms > max(EXPLAINED, levels[-1].rms):
            failed.append(level)
            break
        levels.append(level)
    progress(1.0)
    last = levels[-1]
    if last.rms > _LOST:
        raise IdentificationError(
            f"the model does not explain the record: prediction errors are {last.rms:.1f} times what they should be; "
            "record with more excitation, or start nearer to the machine (--params-file, --set); check encoder "
            "resolution, bias current and pole area there"
        )
    free = list(unknowns.free)
    before = levels[-2].vector if len(levels) > 1 else unknowns.start
    neighbours = [before, *(level.vector for level in failed)]
    search.take_gains(last.vector, last.missed)
    errors = search.residuals(last.vector) / search.gains[BURN_IN:, 3]
    block = max(1, round(_BLOCK / (recording.period_ns * 1e-9)))
    return Fit(
        vector=last.vector,
        covariance=_covariance(last.jacobian, last.residuals, block),
        pulls=np.array([(last.vector - other)[free] for other in neighbours]),
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
    inverse = np.linalg.inv(information + np.eye(len(information)) / PRIOR**2)
    count = len(residuals) // block
    used = slice(0, count * block)
    scores = (jacobian[used] * residuals[used, None]).reshape(count, block, -1).sum(axis=1)
    spread = inverse @ (scores.T @ scores) @ inverse * count / max(1, count - len(information))
    # The prior's own part: near zero where the record tells the parameter.
    return np.asarray(spread + inverse @ inverse / PRIOR**2)
