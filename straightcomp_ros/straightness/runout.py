"""How the map goes on beyond the survey: a smooth run-out to a constant value.

Over the run-out's length L the slope falls from the end's slope s to zero as a cubic Hermite curve,
from the end's curvature c to zero; its integral is the value. With distance t from the end, u = t/L:

    slope(t)  = s (1 − 3u² + 2u³) + c L (u − 2u² + u³)
    value(t)  = v + s (t − t³/L² + t⁴/(2L³)) + c (t²/2 − 2t³/(3L) + t⁴/(4L²))
    value(L)  = v + s L/2 + c L²/12

Value, slope and curvature go on at both ends. That is the quintic with these six end conditions whose
fifth-degree term vanishes, because the held value is free: it is where the guide's slope leads, and
the platform is not called back.
"""

from __future__ import annotations

from typing import NamedTuple


class Runout(NamedTuple):
    """Polynomial coefficients of the value over t, constant first, and the values it passes at rest."""

    coefficients: tuple[float, float, float, float, float]
    held: float
    turning: float
    """Value where the slope is zero on the way (the held value if it is not)."""


def runout(value: float, slope: float, curvature: float, length: float) -> Runout:
    """Run out from an end over ``length`` in m; slope and curvature are with respect to t, outward.

    Args:
        value: m.
        slope: m/m.
        curvature: 1/m.
        length: m, > 0.
    """
    coefficients = (
        value,
        slope,
        curvature / 2.0,
        -slope / length**2 - 2.0 * curvature / (3.0 * length),
        slope / (2.0 * length**3) + curvature / (4.0 * length**2),
    )
    held = value + slope * length / 2.0 + curvature * length**2 / 12.0
    # slope(t) = (1 − u)² (s (1 + 2u) + c L u): one zero at most inside.
    divisor = 2.0 * slope + curvature * length
    u = -slope / divisor if divisor else 0.0
    turning = held
    if 0.0 < u < 1.0:
        c0, c1, c2, c3, c4 = coefficients
        t = u * length
        turning = c0 + t * (c1 + t * (c2 + t * (c3 + t * c4)))
    return Runout(coefficients, held, turning)
