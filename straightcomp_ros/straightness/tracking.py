"""Velocity and acceleration of the stage from its position samples: a fading-memory α-β-γ filter.

In steady state the gains are those of critical damping, all three poles at θ = exp(−2π bandwidth T):

    α = 1 − θ³,   β = (3/2) (1 − θ)² (1 + θ),   γ = (1 − θ)³

with x += α e, v += β e/T, a += γ e/T² (γ is twice the third gain where T²/2 is factored out). A constant
acceleration is followed without error. After a start the gains are those of the growing-memory filter,
which is least squares over all samples since, until its α falls to the steady one: velocity is right
from the third sample on, with no transient.

Sources: E. Brookner, Tracking and Kalman Filtering Made Easy, 1998, chapters 1 and 7 (critically damped
g-h-k filter, expanding- and fading-memory polynomial filters); N. Morrison, Introduction to Sequential
Smoothing and Prediction, 1969.
"""

from __future__ import annotations

import math


class TrackingFilter:
    """Estimates of position, velocity and acceleration; deterministic, plain floats.

    Attributes:
        x, v, a: the estimates in m, m/s, m/s².
    """

    def __init__(self, bandwidth: float) -> None:
        """``bandwidth`` in Hz: of the three equal poles."""
        self._rate = 2.0 * math.pi * bandwidth
        self.restart(0.0)

    def restart(self, x: float) -> None:
        """Forget all samples; stand at ``x`` in m."""
        self.x, self.v, self.a = x, 0.0, 0.0
        self._samples = 1
        self._growing = True

    def update(self, dt: float, x: float) -> None:
        """Take the sample ``x`` in m, ``dt`` in s after the last one; dt may differ from sample to sample."""
        theta = math.exp(-self._rate * dt)
        fade = 1.0 - theta
        alpha = 1.0 - theta * theta * theta
        beta = 1.5 * fade * fade * (1.0 + theta)
        gamma = fade * fade * fade
        if self._growing:
            alpha, beta, gamma = self._growing_gains(alpha, beta, gamma)
        error = x - (self.x + dt * (self.v + 0.5 * dt * self.a))
        self.x = x + (alpha - 1.0) * error
        self.v += dt * self.a + beta * error / dt
        self.a += gamma * error / (dt * dt)

    def _growing_gains(self, alpha: float, beta: float, gamma: float) -> tuple[float, float, float]:
        n = self._samples
        self._samples += 1
        if n == 1:
            return 1.0, 1.0, 0.0  # a straight line through two points
        product = (n + 1.0) * (n + 2.0) * (n + 3.0)
        growing = 3.0 * (3.0 * n * n + 3.0 * n + 2.0) / product
        if growing <= alpha:
            self._growing = False
            return alpha, beta, gamma
        return growing, 18.0 * (2.0 * n + 1.0) / product, 60.0 / product
