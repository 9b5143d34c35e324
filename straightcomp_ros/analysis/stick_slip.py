"""Stick-slip of the platform: it stands while its reference moves on, then jumps after it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STUCK = 0.4e-6
"""Way in m by which the reference runs on while the platform stands, that makes a stick: four counts of the encoder."""
STANDING = 0.15e-6
"""Distance in m within which the platform counts as standing: one count of 0.1 µm to and fro."""
SLIP_TIME = 0.02
"""Time in s after a stick within which the platform must have jumped."""
SLIP = 0.5
"""Part of the stick that the platform makes good in that time, beyond the reference's own motion."""


@dataclass(frozen=True)
class StickSlip:
    """One event: began at ``time`` (s) and ``x`` (m), stood for ``duration`` (s), then jumped by ``slip`` (m)."""

    time: float
    x: float
    duration: float
    slip: float


def stick_slips(
    time: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64], r: NDArray[np.float64]
) -> list[StickSlip]:
    """The events in one stroke; all arrays (n,), in s and m, as the encoders see them."""
    events = []
    for start, stop in _standing(y):
        ahead = r[stop - 1] - r[start]
        if abs(ahead) < STUCK:
            continue
        until = int(np.searchsorted(time, time[stop - 1] + SLIP_TIME))
        way = np.sign(ahead)
        gained = way * ((y[stop - 1 : until + 1] - y[stop - 1]) - (r[stop - 1 : until + 1] - r[stop - 1]))
        if len(gained) and gained.max() >= SLIP * abs(ahead):
            slip = float(np.abs(y[stop - 1 : until + 1] - y[stop - 1]).max())
            events.append(StickSlip(float(time[start]), float(x[start]), float(time[stop - 1] - time[start]), slip))
    return events


def _standing(y: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Samples (first, one after the last) of each longest stretch that stays within :data:`STANDING` of its start."""
    places = np.concatenate([[0], np.flatnonzero(np.diff(y)) + 1, [len(y)]]).tolist()
    levels = y[places[:-1]].tolist()
    stretches, start = [], 0
    for place, level in zip(places[:-1], levels, strict=True):
        if abs(level - y[start]) > STANDING:
            stretches.append((start, place))
            start = place
    stretches.append((start, len(y)))
    return stretches
