"""Generalised Maxwell-slip friction (Al-Bender, Lampaert, Swevers, IEEE TAC 50(11), 2005).

Elasto-slip blocks in parallel. Block i carries the force F_i and holds the share α_i of the Stribeck level s(v):

    stuck:    Ḟ_i = k_i v, until |F_i| = α_i s(v)
    slipping: Ḟ_i = sgn(v) C (α_i − F_i/s(v)), until v changes its sign
    F = Σ F_i + σ1 v Σ_stuck k_i/σ0 + σ2 v,   Σ α_i = 1,   Σ k_i = σ0

While a block slips, |F_i| rises at most at k_i |v| here. Without this bound, a block whose level rises faster than the
motion bends it would store energy that nothing supplied.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.parameters.declaration import parameter

MOST_BLOCKS = 8
"""Room for blocks in the plant's constants and state."""


@dataclass(frozen=True)
class MaxwellSlipParameters:
    """The blocks; their stiffnesses add up to σ0, and their slip limits to the Stribeck level."""

    blocks: int = parameter(4, "Number of elasto-slip blocks", "[1, 8]")
    attraction: float = parameter(
        100.0, "Attraction parameter C: how fast a slipping block follows the Stribeck level", "(0, 1e+12] N/s"
    )
    distance_spread: float = parameter(
        10.0, "Displacement at which the last block slips over that of the first", "[1, 1000]"
    )
    limit_spread: float = parameter(1.0, "Slip limit of the last block over that of the first", "[0.001, 1000]")

    def stiffnesses_and_shares(self, stiffness: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """k_i in N/m, which add up to ``stiffness``, and α_i; both (blocks,), geometric from the first to the last."""
        place = np.linspace(0.0, 1.0, self.blocks)
        shares = self.limit_spread**place
        springs = shares / self.distance_spread**place
        return stiffness * springs / springs.sum(), shares / shares.sum()


@compilable
def slips_on(slipping: bool, force: float, velocity: float) -> bool:
    """Whether a block that was slipping still does: it sticks when the velocity has changed its sign."""
    return slipping and force * velocity > 0.0


@compilable
def block_after(
    force: float, slipping: bool, stiffness: float, limit: float, decay: float, velocity: float, duration: float
) -> tuple[float, bool]:
    """Force in N and whether the block slips after ``duration`` s at constant velocity.

    Args:
        force, slipping: before.
        stiffness: k_i in N/m.
        limit: α_i s(v) in N.
        decay: exp(−C/s(v) · duration), 0 for an infinite attraction.
        velocity: m/s.
        duration: s.
    """
    if velocity == 0.0:
        return force, False
    resisting = math.copysign(1.0, velocity) * force
    bent = resisting + stiffness * abs(velocity) * duration
    if not slips_on(slipping, force, velocity):
        if bent <= limit:
            return math.copysign(1.0, velocity) * bent, False
        # It reaches its limit within the step and stays there, or the limit has fallen below its force.
        resisting = max(resisting, limit)
    after = min(limit + (resisting - limit) * decay, bent)
    return math.copysign(1.0, velocity) * after, True
