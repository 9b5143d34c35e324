"""Checks that the bags contain the strokes that the stage made.

A stroke counts if it is one movement of the stage one way, rest to rest, that was commanded and took place completely
while the recording was known to be complete: the driver was active all the time, the logger's reports said that it
recorded, and neither was stopped, paused, killed, deactivated or restarted meanwhile. Its commanded time follows from
the time at which the stage was seen to leave its rest and from its trajectory, not from the bags. It is found if the
encoder stream of a bag has a stroke (:func:`straightcomp_ros.analysis.record.motion_of`) in the same direction that
covers more than half of its time and takes at most half as long again. Missing samples within a stroke are not
checked here.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from straightcomp_ros.analysis.record import MetricsError, motion_of
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.recovery import default_output, recover
from straightcomp_ros.contract import ENCODER
from straightcomp_ros.straightness.survey import Direction

_LONGEST = 1.5
"""A recorded stroke that takes longer than so many commanded ones is several, detected as one."""


class Stroke(NamedTuple):
    """A movement one way: begin and end, ns since the epoch."""

    begin_ns: int
    end_ns: int
    direction: Direction


class Commanded:
    """Notes when the stage moved and when that was recorded; all times in ns since the epoch.

    Args:
        stroke_ns: duration of a stroke; forward and backward in turn, the first forward.
        strokes: number of strokes in a motion.
    """

    def __init__(self, stroke_ns: int, strokes: int) -> None:
        self._stroke_ns, self._strokes = stroke_ns, strokes
        self.motions: list[tuple[int, int]] = []
        self._recordings: list[tuple[int, int]] = []
        self.moving = self.recording = 0
        """Begin of the present motion, and of the recording that is known to be complete; 0 without."""

    def end(self, at_ns: int) -> None:
        """Note that the motion ended, finished or not; without effect if there is none."""
        if self.moving:
            self.motions.append((self.moving, min(at_ns, self.moving + self._strokes * self._stroke_ns)))
        self.moving = 0

    def over(self, now_ns: int) -> bool:
        """Whether the motion has made all its strokes."""
        return self.moving > 0 and now_ns > self.moving + self._strokes * self._stroke_ns

    def interrupt(self, at_ns: int) -> None:
        """Note that the recording is not known to be complete from now on."""
        if self.recording and at_ns > self.recording:
            self._recordings.append((self.recording, at_ns))
        self.recording = 0

    def strokes(self) -> list[Stroke]:
        """The strokes that count, of all motions and recordings that have ended."""
        made = [
            Stroke(begin, begin + self._stroke_ns, "backward" if number % 2 else "forward")
            for first, end in self.motions
            for number, begin in enumerate(range(first, end - self._stroke_ns + 1, self._stroke_ns))
        ]
        return [
            one for one in made if any(begin <= one.begin_ns and one.end_ns <= end for begin, end in self._recordings)
        ]


def strokes_in(bag: Path, motions: Sequence[tuple[int, int]]) -> list[Stroke]:
    """The strokes in a bag, for each motion separately: between two motions the stage's position may jump.

    Raises:
        BagError: the bag cannot be read.
    """
    streams = read_streams(bag, {ENCODER.topic: ENCODER.layout})
    if ENCODER.topic not in streams:
        return []
    stamps, first = np.unique(streams[ENCODER.topic].stamp, return_index=True)
    x = streams[ENCODER.topic].columns["x"][first]
    found = []
    for begin_ns, end_ns in motions:
        inside = (stamps >= begin_ns) & (stamps <= end_ns)
        of_motion = stamps[inside]
        try:
            strokes = motion_of((of_motion - begin_ns) * 1e-9, x[inside]).strokes
        except MetricsError:
            continue
        found += [Stroke(int(of_motion[one.start]), int(of_motion[one.stop - 1]), one.direction) for one in strokes]
    return found


def missing(commanded: Sequence[Stroke], found: Sequence[Stroke]) -> list[Stroke]:
    """Strokes that were commanded but not found."""
    return [stroke for stroke in commanded if not any(_is(stroke, other) for other in found)]


def _is(stroke: Stroke, found: Stroke) -> bool:
    duration = stroke.end_ns - stroke.begin_ns
    common = min(stroke.end_ns, found.end_ns) - max(stroke.begin_ns, found.begin_ns)
    same = stroke.direction == found.direction
    return same and common > 0.5 * duration and found.end_ns - found.begin_ns <= _LONGEST * duration


def readable(bag: Path) -> tuple[Path, bool]:
    """The bag itself if it was finished, otherwise what `recover` makes of it; and whether it was finished.

    Raises:
        BagError: nothing in it can be recovered.
    """
    if (bag / "metadata.yaml").exists():
        return bag, True
    output = default_output(bag)
    if not recover(bag, output).saved:
        raise BagError(f"bag {bag}: no message could be saved")
    return output, False
