"""One recorded run of the machine, its reference over x, and when the stage moved."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.survey_header import Direction

Array = NDArray[np.float64]
SPEED_SPAN = 0.02
"""Time in s over which the stage's speed is taken: one encoder quantum of 0.1 µm is then 5 µm/s."""
MOVING = 0.5e-3
"""Speed in m/s from which the stage counts as moving: reached 2.5 ms after a start at 0.2 m/s²."""
_CREEPING = 0.1
"""The same relative to the fastest, for slow stages."""
ARRIVED = 1e-6
"""Distance in m from a stroke's resting ends within which the stage counts as standing: above its jitter."""
SHORTEST_STROKE = 0.05e-3
"""Travel in m below which a movement is no stroke: half of the shortest jog."""
_WHOLE = 0.9
"""Fraction of the longest travel from which a movement is whole: others were broken off, lead to the start, or jog."""
_LEAST_JUMP = 1e-3
"""Change of x from sample to sample, in m, below which it is no jump."""
AT_LIMIT = 1.0 - 1e-9
"""Fraction of the current limit from which the command counts as limited."""
_APART = 1e-9
"""m between the references of two directions: far below any encoder, far above interpolation between samples."""
_NEAR = 1e-3
"""Distance in m of recorded positions, over which a curvature of 1e-3 1/m makes 0.1 nm."""
_FASTEST_CHANGE = 1000.0
"""Acceleration in m/s² that no linear motor gives a stage: the fastest reach some 300."""
_MOST = 1000.0
"""Metres and amperes that no machine has: figures over x would take all memory."""


class MetricsError(ValueError):
    """A record cannot be evaluated; the message names the column and the sample."""


@dataclass(frozen=True, eq=False)
class StrokeRecord:
    """One run at the sample rate: all arrays (n,), sample k of each belonging to the same encoder sample. Times in s
    from the start of the record, rising; samples may be missing."""

    time: Array
    x: Array  # slider as the encoder sees it, m
    y: Array  # platform, likewise
    r: Array  # reference, m
    current: Array  # control current i_c commanded, A
    law: str
    true_x: Array | None = None  # true positions, m; None on real hardware
    true_y: Array | None = None
    guide: Array | None = None  # true deviation δ of the guide at true_x, m; None on real hardware

    @cached_property
    def motion(self) -> Motion:
        """:func:`motion_of` the record, from the x encoder; MetricsError also if time or x is not finite."""
        self.check_finite(("time", "x"), slice(None))
        return motion_of(self.time, self.x)

    @cached_property
    def reference(self) -> RecordedReference:
        """Over x, as the run used it."""
        return RecordedReference(self)

    @cached_property
    def moving(self) -> StrokeRecord:
        """From the first to the last sample of motion, with the pauses between the strokes."""
        return self.part(self.motion.window)

    def best_known(self, straightness: ReferenceMap) -> tuple[Array, Array, Array]:
        """Slider x, platform y and the guide's deviation there, (n,) each in m: the truth, or else the values of the
        encoders and of the map."""
        if self.true_x is None or self.true_y is None or self.guide is None:
            return self.x, self.y, self.guide_by(straightness)
        return self.true_x, self.true_y, self.guide

    def followed(self, straightness: ReferenceMap) -> Array:
        """r (n,) in m at the true x, or else at the measured one; of two tables as it was recorded, since a count in x
        is nothing in r."""
        if straightness.directed:
            return self.r
        return straightness.evaluate(self.x if self.true_x is None else self.true_x)[0]

    def guide_by(self, straightness: ReferenceMap) -> Array:
        """The guide's deviation (n,) in m at the measured x, up to a constant; of two tables by r, unless it was
        centred."""
        return -self.r if straightness.directed and np.ptp(self.r) else straightness.deviations(self.x)

    def true_error(self, straightness: ReferenceMap) -> Array | None:
        """r(true x) − true y, (n,) in m; None without truth."""
        if self.true_x is None or self.true_y is None:
            return None
        return self.followed(straightness) - self.true_y

    def columns(self) -> dict[str, Array]:
        """All arrays by name, without those that are None."""
        named = ((one.name, getattr(self, one.name)) for one in fields(self) if one.name != "law")
        return {name: column for name, column in named if column is not None}

    def part(self, samples: slice) -> StrokeRecord:
        """These samples; their times stay those of the record."""
        columns: dict[str, Any] = {name: values[samples] for name, values in self.columns().items()}
        return replace(self, **columns)

    def check_finite(self, names: Iterable[str], window: slice) -> None:
        """Raise MetricsError if the columns ``names`` within ``window`` have a number that no machine has."""
        for name in names:
            column = self.columns()[name]
            most = np.inf if name == "time" else _MOST
            bad = np.flatnonzero(~(np.abs(column[window]) < most)) + (window.start or 0)
            if bad.size:
                raise MetricsError(
                    f"record: {name} is {column[bad[0]]} at sample {bad[0]} ({self.time[bad[0]]:.6g} s), "
                    f"one of {bad.size}; allowed: numbers between {-most:g} and {most:g}"
                )


class RecordedReference:
    """r(x) as a run used it, by straight lines between the recorded samples; needs no survey file.

    At 0.3 m/s and 2 kHz the samples are h = 0.15 mm apart; a curvature r'' of 1e-3 1/m then makes h²r''/8 = 3 pm.
    """

    def __init__(self, record: StrokeRecord) -> None:
        self._record = record
        finite = np.isfinite(record.x) & np.isfinite(record.r)
        self._x, rows = np.unique(record.x[finite], return_index=True)
        self._r = record.r[finite][rows]

    @cached_property
    def directed(self) -> bool:
        """Whether r was another one on the way back: no function of x then."""
        run, ways = self._record, []
        with suppress(MetricsError):
            ways = [run.motion.samples("forward"), run.motion.samples("backward")]
        if not ways or not all(way.size for way in ways):
            return False
        (x, forward), (back, r) = ((run.x[way], run.r[way]) for way in ways)
        order = np.argsort(x, kind="stable")
        shared = (back >= x.min()) & (back <= x.max())
        apart = np.abs(np.interp(back[shared], x[order], forward[order]) - r[shared])
        return bool(apart.size and np.nanmedian(apart) > _APART)

    def evaluate(self, x: ArrayLike) -> tuple[Array]:
        """r in m at x in m; beyond the recorded positions that of the nearest."""
        return (np.asarray(np.interp(np.asarray(x, np.float64), self._x, self._r)),)

    def recorded_around(self, x: Array) -> NDArray[np.bool_]:
        """Whether each x (n,) in m lies between recorded positions so near to each other that r is known there."""
        after = np.searchsorted(self._x, x)
        inside = (after > 0) & (after < self._x.size)
        places = np.where(inside, after, 0)
        return np.asarray(inside & (self._x[places] - self._x[places - 1] <= _NEAR))

    def deviations(self, x: ArrayLike) -> Array:
        """δ in m, up to a constant."""
        return -self.evaluate(x)[0]


ReferenceMap = StraightnessMap | RecordedReference


@dataclass(frozen=True)
class Stroke:
    """A movement one way: samples ``start`` to ``stop`` (exclusive)."""

    start: int
    stop: int
    direction: Direction

    @property
    def samples(self) -> slice:
        """All samples of the movement."""
        return slice(self.start, self.stop)


@dataclass(frozen=True)
class Motion:
    """When the stage moved: its strokes in order, at least one. Pauses belong to no stroke."""

    strokes: tuple[Stroke, ...]

    @property
    def window(self) -> slice:
        """From the first to the last sample of motion, pauses between strokes included."""
        return slice(self.strokes[0].start, self.strokes[-1].stop)

    def samples(self, direction: Direction | None = None) -> NDArray[np.intp]:
        """Indices of the samples in motion, in order: of one direction, or of both."""
        chosen = [stroke for stroke in self.strokes if direction in (None, stroke.direction)]
        return np.concatenate([np.arange(0), *(np.arange(stroke.start, stroke.stop) for stroke in chosen)])


def motion_of(time: Array, x: Array) -> Motion:
    """The strokes in a motion: ``time`` (n,) in s and ``x`` (n,) in m, finite; see :func:`strokes_and_jumps`.

    Raises:
        MetricsError: there is no stroke.
    """
    n = time.size
    if n < 3:
        raise MetricsError(f"record: {n} samples; allowed: >= 3")
    strokes, jumps = strokes_and_jumps(time, x)
    if not strokes:
        jumped = [f"x jumps by {abs(x[at] - x[at - 1]) * 1e3:.6g} mm at {time[at]:.6g} s, and " for at in jumps[:1]]
        raise MetricsError(
            f"record: {''.join(jumped)}the stage does not move: x stays within {np.ptp(x) * 1e3:.6g} mm; "
            f"allowed: at least one stroke of {SHORTEST_STROKE * 1e3:g} mm"
        )
    return Motion(strokes)


def strokes_and_jumps(time: Array, x: Array) -> tuple[tuple[Stroke, ...], NDArray[np.intp]]:
    """The strokes in a motion of at least three samples, ``time`` (n,) in s rising and ``x`` (n,) in m finite, and the
    samples (m,) at which x jumps: it is not where a stage can have gone since the sample before, because an encoder
    failed, a driver was started again, or there are two drivers. A move over a gap of ``time`` is no jump.

    Speed is taken over :data:`SPEED_SPAN`, which hides the quantisation of x, but makes a stroke seem longer at both
    ends. The ends are then moved in to where x leaves its resting value by :data:`ARRIVED`. At 0.2 m/s² that is 3 ms
    after the stage began to move.
    """
    steps = np.diff(time)
    period = float(np.median(steps))
    # More than one where samples were lost; the mean move is known there too.
    periods = np.maximum(np.rint(steps / period), 1.0)
    moves = np.diff(x) / periods
    allowed = max(_LEAST_JUMP, _FASTEST_CHANGE * period**2)
    change = np.abs(np.diff(moves)) > 0.5 * allowed * (periods[:-1] + periods[1:])
    # A jump changes the move twice: into it, and out of it.
    sudden = np.append(change, False) | np.append(False, change)
    jumps = np.flatnonzero(sudden & (periods == 1.0) & (np.abs(moves) > allowed)) + 1
    pieces = itertools.pairwise([0, *jumps.tolist(), time.size])
    half = max(1, round(0.5 * SPEED_SPAN / period))
    return tuple(stroke for start, stop in pieces for stroke in _strokes(time, x, start, stop, half)), jumps


def _strokes(time: Array, x: Array, first: int, end: int, half: int) -> Iterator[Stroke]:
    """The strokes among the samples ``first`` to ``end``; the speed is taken over ``half`` samples to each side."""
    time, x = time[first:end], x[first:end]
    n = x.size
    # Cut off at the ends.
    before, after = np.maximum(np.arange(n) - half, 0), np.minimum(np.arange(n) + half, n - 1)
    with np.errstate(invalid="ignore"):
        # A single sample has no speed.
        speed = (x[after] - x[before]) / (time[after] - time[before])
    fastest = float(np.max(np.abs(speed), initial=0.0, where=np.isfinite(speed)))
    slowest = min(MOVING, _CREEPING * fastest)
    way = np.where(np.abs(speed) >= slowest, np.sign(speed), 0.0)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(way)) + 1, [n]])
    for start, stop in itertools.pairwise(edges.tolist()):
        piece = x[start:stop]
        if way[start] != 0.0 and abs(piece[-1] - piece[0]) >= SHORTEST_STROKE:
            away = np.flatnonzero((np.abs(piece - piece[0]) > ARRIVED) & (np.abs(piece - piece[-1]) > ARRIVED))
            # Samples at one place have no speed, and no line.
            if away.size and piece[away[0]] != piece[away[-1]]:
                direction: Direction = "forward" if way[start] > 0.0 else "backward"
                yield Stroke(first + start + int(away[0]), first + start + int(away[-1]) + 1, direction)


def whole(travels: ArrayLike, way: float | None = None) -> NDArray[np.bool_]:
    """Which movements with these travels (n,) go all the ``way``, or that of the longest."""
    travels = np.asarray(travels)
    return np.asarray(travels >= _WHOLE * (np.max(travels, initial=0.0) if way is None else way))


def whole_ways(strokes: Sequence[Stroke], x: Array) -> tuple[list[list[Stroke]], list[list[Stroke]]]:
    """Of a motion's strokes, at least one, over ``x`` (n,) in m, the ways that are whole, and the others: successive
    strokes in one direction are one way, unless the stage came back unrecorded between them."""
    ways: list[list[Stroke]] = []
    for one in strokes:
        last = ways[-1][-1] if ways else None
        if last and one.direction == last.direction:
            onward = float(x[one.start] - x[last.stop - 1])
            if (onward if one.direction == "forward" else -onward) > -SHORTEST_STROKE:
                ways[-1].append(one)
                continue
        ways.append([one])
    travels = [abs(float(x[way[-1].stop - 1] - x[way[0].start])) for way in ways]
    found: tuple[list[list[Stroke]], list[list[Stroke]]] = [], []
    for way, is_whole in zip(ways, whole(travels).tolist(), strict=True):
        found[not is_whole].append(way)
    return found


def runs_of(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(m, 2) first sample and the one after the last of each run of True in ``mask`` (n,)."""
    return np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2)


def speed_at_end(time: Array, x: Array) -> float:
    """Speed in m/s at the last of the samples ``time`` (n,) in s and ``x`` (n,) in m, by a parabola through those of
    :data:`SPEED_SPAN`, at least five: at the last sample of a whole stroke the stage stands. 0 where it has fewer."""
    if time.size < 5:
        return 0.0
    steps = np.diff(time)
    count = max(5, round(SPEED_SPAN / float(np.median(steps))))
    if time.size < count or (steps[1 - count :] > 1.5 * np.median(steps)).any():
        return 0.0
    _, speed, _ = np.polyfit(time[-count:] - time[-1], x[-count:], 2)
    return abs(float(speed))


def group_means(x: Array, y: Array, group: NDArray[Any]) -> tuple[Array, Array]:
    """Mean of x and of y in each group, the groups in ascending order."""
    _, piece = np.unique(group, return_inverse=True)
    count = np.bincount(piece)
    return np.bincount(piece, x) / count, np.bincount(piece, y) / count
