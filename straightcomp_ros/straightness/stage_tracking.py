"""Velocity and acceleration of the stage from its position samples: a fading-memory α-β-γ filter.

In steady state the gains are those of critical damping, all three poles at θ = exp(−2π bandwidth T):

    α = 1 − θ³,   β = (3/2) (1 − θ)² (1 + θ),   γ = (1 − θ)³

with x += α e, v += β e/T, a += γ e/T² (γ is twice the third gain where T²/2 is factored out). A constant
acceleration is followed without error. After a start the gains are those of the growing-memory filter, which is
least squares over all samples since then, until its α falls to the steady one: velocity is right from the third sample
on, with no transient.

Sources: E. Brookner, Tracking and Kalman Filtering Made Easy, 1998, chapters 1 and 7 (critically damped
g-h-k filter, expanding- and fading-memory polynomial filters); N. Morrison, Introduction to Sequential
Smoothing and Prediction, 1969.
"""

import math
from typing import NamedTuple

from straightcomp_ros.model.compiled import compilable


class Tracked(NamedTuple):
    """Estimates of position in m, velocity in m/s and acceleration in m/s², and the number of samples in the growing
    memory, 0 once the gains are the steady ones."""

    x: float
    v: float
    a: float
    samples: int


@compilable
def restarted(x: float) -> Tracked:
    """The estimates without earlier samples: at rest at ``x`` in m."""
    return Tracked(x, 0.0, 0.0, 1)


@compilable
def updated(bandwidth: float, last: Tracked, dt: float, x: float) -> Tracked:
    """The estimates after the sample ``x`` in m, ``dt`` in s after the last one; dt may differ from sample to sample.

    ``bandwidth`` in Hz is that of the three equal poles.
    """
    theta = math.exp(-2.0 * math.pi * bandwidth * dt)
    fade = 1.0 - theta
    alpha = 1.0 - theta * theta * theta
    beta = 1.5 * fade * fade * (1.0 + theta)
    gamma = fade * fade * fade
    n = last.samples
    if n == 1:
        alpha, beta, gamma, n = 1.0, 1.0, 0.0, 2  # a straight line through two points
    elif n:
        product = (n + 1.0) * (n + 2.0) * (n + 3.0)
        growing = 3.0 * (3.0 * n * n + 3.0 * n + 2.0) / product
        if growing > alpha:
            alpha, beta, gamma, n = growing, 18.0 * (2.0 * n + 1.0) / product, 60.0 / product, n + 1
        else:
            n = 0
    error = x - (last.x + dt * (last.v + 0.5 * dt * last.a))
    return Tracked(
        x + (alpha - 1.0) * error,
        last.v + (dt * last.a + beta * error / dt),
        last.a + gamma * error / (dt * dt),
        n,
    )
