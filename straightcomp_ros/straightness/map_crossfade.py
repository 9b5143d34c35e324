"""From one map to another without a bump in the reference.

The weight of the old map goes from 1 to 0 along the quintic 1 − s³(10 − 15 s + 6 s²), whose first two derivatives are
zero at both ends: r, ṙ and r̈ are continuous, and for maps that differ by D and a time T the speed changes by at most
1.875 D/T and the acceleration by 5.774 D/T², beside the maps' own rates.
"""

from __future__ import annotations

from collections.abc import Callable

FADE_TIME = 0.5
"""s, from the old map to the new one."""

Lookup = Callable[[float], tuple[float, float, float]]
Rates = tuple[float, float, float]


def weight(elapsed: float, duration: float) -> Rates:
    """Weight of the old map ``elapsed`` s after the change, its rate in 1/s and acceleration in 1/s²."""
    s = elapsed / duration
    if s <= 0.0:
        return 1.0, 0.0, 0.0
    if s >= 1.0:
        return 0.0, 0.0, 0.0
    rest = 1.0 - s
    return (
        1.0 - s * s * s * (10.0 - 15.0 * s + 6.0 * s * s),
        -30.0 * s * s * rest * rest / duration,
        -60.0 * s * rest * (1.0 - 2.0 * s) / (duration * duration),
    )


def blended(old: Rates, new: Rates, fade: Rates) -> Rates:
    """r in m, ṙ in m/s and r̈ in m/s² between two references, by the old one's weight and the weight's rates."""
    w, w_dot, w_ddot = fade
    d, d_dot, d_ddot = (before - after for before, after in zip(old, new, strict=True))
    return new[0] + w * d, new[1] + w * d_dot + w_dot * d, new[2] + w * d_ddot + 2.0 * w_dot * d_dot + w_ddot * d
