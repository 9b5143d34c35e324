"""The covariance of a least-squares solution whose residuals are alike within a block of samples."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCK = 0.25
"""Length in s of the blocks that count as independent: quantisation errors are correlated over some 0.1 s."""


def block_covariance(jacobian: Array, residuals: Array, block: int, prior: float = np.inf) -> Array:
    """(m, m): (JᵀJ)⁻¹ (Σ s sᵀ) (JᵀJ)⁻¹ with s = Jᵀr of each block, so that errors may be alike within a block.

    Args:
        jacobian: J, (n, m).
        residuals: r, (n,).
        block: samples of a block.
        prior: standard deviation of a prior around the solution; what the residuals do not determine gets it.
    """
    information = jacobian.T @ jacobian
    inverse = np.linalg.inv(information + np.eye(len(information)) / prior**2)
    count = len(residuals) // block
    used = slice(0, count * block)
    scores = (jacobian[used] * residuals[used, None]).reshape(count, block, -1).sum(axis=1)
    spread = inverse @ (scores.T @ scores) @ inverse * count / max(1, count - len(information))
    return np.asarray(spread + inverse @ inverse / prior**2)
