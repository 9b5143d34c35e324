"""Figures of each movement together with what follows it: how soon the error is settled, standstill, and reversal.

A movement is judged by the error r − y where its own stroke is judged too: the true one where it is known, else the
encoder's. What follows lasts until the next movement or to the end of the record.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from straightcomp_ros.analysis.record import ReferenceMap, StrokeRecord
from straightcomp_ros.straightness.residual import peak_to_peak

SETTLED = 0.1e-6
"""Band in m, either way, within which the error counts as settled: a count of the shipped encoder."""
_REVERSAL = 0.1
"""Time in s before and after a reversal in which its error is made: ten periods of a loop's bandwidth of 100 Hz."""


@dataclass(frozen=True)
class StandstillFigures:
    """Of one movement, in s and m; None where the record does not show it.

    ``settling`` is the time from the last sample of motion until the error stays within the band up to the next motion:
    0 if it does at once, NaN if it never does. The standstill is what follows that, or the whole rest if it never
    settles. The reversal is the last time before and the first after a change of direction, pauses left out.
    """

    settling: float | None = None
    standstill_pp: float | None = None
    standstill_rms: float | None = None
    reversal_pp: float | None = None

    def to_display(self) -> dict[str, Any]:
        """The figures as a person reads them: lengths in µm, the unit in each name."""
        lengths = {name: getattr(self, name) for name in ("standstill_pp", "standstill_rms", "reversal_pp")}
        return {"settling_s": self.settling} | {
            f"{name}_um": None if value is None else value * 1e6 for name, value in lengths.items()
        }


def standstill_figures(record: StrokeRecord, reference: ReferenceMap, band: float = SETTLED) -> list[StandstillFigures]:
    """Figures of each of the record's movements, in their order; ``band`` in m."""
    truth, strokes = record.true_error(reference), record.motion.strokes
    error = record.r - record.y if truth is None else truth
    period = float(np.median(np.diff(record.time)))
    around, found = max(1, round(_REVERSAL / period)), []
    for number, stroke in enumerate(strokes):
        following = strokes[number + 1] if number + 1 < len(strokes) else None
        rest = error[stroke.stop : following.start if following else None]
        reversal = None
        if following and following.direction != stroke.direction:
            before, after = error[stroke.start : stroke.stop], error[following.start : following.stop]
            reversal = peak_to_peak(np.concatenate([before[-around:], after[:around]]))
        if not (rest.size and np.isfinite(rest).all()):
            found.append(StandstillFigures(reversal_pp=reversal))
            continue
        outside = np.flatnonzero(np.abs(rest) > band)
        settled = int(outside[-1]) + 1 if outside.size else 0
        lasts = settled < rest.size
        standing = rest[settled:] if lasts else rest
        found.append(
            StandstillFigures(
                settled * period if lasts else math.nan,
                peak_to_peak(standing),
                float(np.sqrt(np.mean(standing * standing))),
                reversal,
            )
        )
    return found
