"""When the host failed the loop in a recorded run: samples or commands that are missing, or came late."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_LATE = 1.0
"""Sampling periods beyond the median from which a sample or command is late: a command that is due one period after its
sample comes too late then, and the board holds the platform by itself."""

PAUSE = 1.0
"""Gap in s between two samples from which the recording was paused: during such a stall of the host the driver or the
board would have switched off."""


class Stall(NamedTuple):
    """A time in which the host failed the loop: first and last moment in s, on the clock of the record."""

    start: float
    end: float


def stalls_of(
    samples: NDArray[np.int64],
    commands: NDArray[np.int64],
    state: NDArray[np.int64],
    driver: Mapping[str, NDArray[np.float64]],
) -> list[Stall]:
    """The stalls, in order and apart from each other, in s from the stamp 0.

    Args:
        samples: (n,) stamps in ns, rising, of the samples that are there.
        commands: (m,) those that have a command.
        state: (k,) stamps of the driver's record of samples; (0,) if it was not recorded.
        driver: its columns by name, (k,) each, see :data:`straightcomp_ros.contract.DRIVER_STATE`; none are needed.
    """
    none = np.full(state.size, np.nan)
    latency, lateness, enabled = (driver.get(name, none) for name in ("command_latency", "lateness", "enabled"))
    period = float(np.median(np.diff(samples)))
    steps = np.diff(samples)
    gaps = np.flatnonzero((steps > 1.5 * period) & (steps < PAUSE * 1e9))
    inside = samples[(samples >= commands[0]) & (samples <= commands[-1])]
    without = inside[~np.isin(inside, commands)]
    late = np.flatnonzero(_late(latency, period * 1e-9))
    later = np.flatnonzero(_late(lateness, period * 1e-9))
    silent = np.isnan(latency) & (enabled == 1.0)
    # More than half: its controller answers several samples at once.
    first, last = _runs(silent if 2 * np.count_nonzero(silent) < silent.size else silent[:0])
    found = [
        *zip(samples[gaps], samples[gaps + 1], strict=True),
        *zip(without, without + period, strict=True),
        *zip(state[late] - latency[late] * 1e9 - period, state[late], strict=True),
        *zip(state[first] - period, state[last], strict=True),
        *zip(state[later], state[later] + lateness[later] * 1e9, strict=True),
    ]
    return _merged((float(start) * 1e-9, float(end) * 1e-9) for start, end in found)


def _late(times: NDArray[np.float64], period: float) -> NDArray[np.bool_]:
    known = times[np.isfinite(times)]
    usual = float(np.median(known)) if known.size else 0.0
    # A comparison with NaN is false.
    return np.asarray(times > usual + _LATE * period)


def _runs(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last index of each stretch of ``mask`` that is longer than one sample."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    first, last = edges[0::2], edges[1::2] - 1
    return first[last > first], last[last > first]


def _merged(times: Iterable[tuple[float, float]]) -> list[Stall]:
    stalls: list[Stall] = []
    for start, end in sorted(times):
        if stalls and start <= stalls[-1].end:
            stalls[-1] = Stall(stalls[-1].start, max(end, stalls[-1].end))
        else:
            stalls.append(Stall(start, end))
    return stalls
