"""Position, coil current and command of one unbroken stretch of a bag, for identification; never the truth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis import IdentificationError
from straightcomp_ros.analysis.recorded_lag import advanced, readback_lag
from straightcomp_ros.bags.reader import StreamColumns, read_streams
from straightcomp_ros.contract import COMMAND, ENCODER

SHORTEST, LONGEST = 2000, 60_000
"""Samples of a stretch: from a second to half a minute at 2 kHz; more would cost much and improve little."""
LEAST_TRAVEL = 2e-6
"""Travel of the platform in m below which it only creeps on its bristles."""
SWITCH_ON = 10
"""Samples after the switch-on that are left out, while the bias current rises."""


@dataclass(frozen=True, eq=False)
class Recording:
    """An unbroken stretch with the amplifier on; all arrays (n,), one entry for each sample.

    Attributes:
        period_ns: sampling period in ns.
        x, y: encoder readings of stage and platform, m.
        current: measured control current of the coils, A.
        command: commanded control current in answer to the sample, A.
        total: samples in the bag.
    """

    period_ns: int
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    current: NDArray[np.float64]
    command: NDArray[np.float64]
    total: int

    @property
    def duration(self) -> float:
        """Length of the stretch in s."""
        return len(self.y) * self.period_ns * 1e-9


def read_recording(bag: Path) -> Recording:
    """The longest stretch of a bag in which the amplifier is on and no sample is missing.

    Raises:
        BagError: the bag cannot be read.
        IdentificationError: a stream is missing, the amplifier is never on long enough, or nothing moves.
    """
    streams = read_streams(bag, {stream.topic: stream.layout for stream in (ENCODER, COMMAND)})
    for stream in (ENCODER, COMMAND):
        if stream.topic not in streams:
            raise IdentificationError(f"bag {bag}: has no messages on '{stream.topic}'; record driver and controller")
    encoder = streams[ENCODER.topic]
    stamps, rows = np.unique(encoder.stamp, return_index=True)
    x, y, current = (encoder.columns[name][rows] for name in ("x", "y", "coil_current"))
    current = advanced(current, readback_lag(bag))
    if not np.isfinite(current).any():
        raise IdentificationError(
            f"bag {bag}: the amplifier is off throughout (coil_current is NaN in all {len(current)} samples); "
            "record with the amplifier on"
        )
    period_ns = round(float(np.median(np.diff(stamps)))) if len(stamps) > 1 else 0
    start, stop = _longest_stretch(stamps, np.isfinite(current) & np.isfinite(y), period_ns)
    if stop - start < SHORTEST:
        raise IdentificationError(
            f"bag {bag}: the longest stretch with the amplifier on and no sample lost has {stop - start} samples; "
            f"allowed: >= {SHORTEST}"
        )
    stretch = slice(start, min(stop, start + LONGEST))
    travel = float(np.ptp(y[stretch]))
    if travel < LEAST_TRAVEL:
        raise IdentificationError(
            f"bag {bag}: nothing moves: the platform stays within {travel * 1e6:.2g} µm, the stage within "
            f"{float(np.ptp(x[stretch])) * 1e3:.3g} mm; allowed: platform >= {LEAST_TRAVEL * 1e6:g} µm; move the stage"
        )
    command = _held(stamps[stretch], streams[COMMAND.topic])
    return Recording(period_ns, x[stretch], y[stretch], current[stretch], command, len(stamps))


def _longest_stretch(stamps: NDArray[np.int64], usable: NDArray[np.bool_], period_ns: int) -> tuple[int, int]:
    """First sample and the one after the last, of the longest run of usable samples a period apart."""
    broken = np.concatenate([[True], (np.diff(stamps) > 1.5 * period_ns) | ~usable[:-1] | ~usable[1:], [True]])
    edges = np.flatnonzero(broken)
    longest = int(np.argmax(np.diff(edges)))
    start, stop = int(edges[longest]), int(edges[longest + 1])
    # At the start of the bag the amplifier may have been on for long, but nothing says so.
    return min(start + SWITCH_ON, stop), stop


def _held(stamps: NDArray[np.int64], stream: StreamColumns) -> NDArray[np.float64]:
    """The command for each stamp; the one before replaces a missing one, as in the amplifier."""
    known, rows = np.unique(stream.stamp, return_index=True)
    commands = stream.columns["control_current"][rows]
    before = np.searchsorted(known, stamps, side="right") - 1
    return np.where(before >= 0, commands[np.maximum(before, 0)], 0.0)
