"""An observation of the graph from outside at one moment, and the error of each movement of the stage in it."""

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from straightcomp_ros.model.paced_motion import StageState

ABSENT, STARTING, SILENT, PLAIN = "absent", "starting", "silent", "plain"
"""States of a node that reports no lifecycle state: it does not run, has not been active yet (it loads or compiles),
does not answer, or has no lifecycle."""
_WORKING = ("active", PLAIN)
_LOOK_BACK_S, _LONGEST_LOOK_BACK_S = 0.1, 10.0
_STILL_M, _LEAST_COUNTS = 50e-6, 8.0
"""Smaller distances in the look-back time count as standstill: 0.5 mm/s; of slower strokes half of their way in that
time, and at their end a quarter. The time is longer where half of the way is less than twice what the difference of two
readings may change by at rest."""
_MOVEMENTS, _WAITING = 4, 20_000
"""Newest movements, and errors without a position yet, that are kept: 10 s at 2 kHz."""


@dataclass(frozen=True)
class Observation:
    """What the nodes report and what their streams show."""

    nodes: Mapping[str, str] = field(default_factory=dict)  # state of each: one of those above, or of the lifecycle
    faults: Mapping[str, str] = field(default_factory=dict)  # fault of each node that has one
    fault_code: int = 0  # of the driver's latched fault; 0 without one
    unrecorded: tuple[str, ...] = ()  # topics that the logger, if there is one, is not connected to
    descriptions: Mapping[str, str] = field(default_factory=dict)  # of the stage, of each node that reports its own
    fresh: bool = False  # samples are arriving
    commissioning: str = ""  # what commissioning, or an excitation of the loop, is doing; empty if none is at work
    amplifier_on: bool = False  # samples are arriving, and the driver reports the amplifier on
    stamp_ns: int = 0  # of the newest sample, ns since the epoch; 0 before the first
    first_ns: int = 0  # stamp of the first sample seen
    x: float = math.nan  # newest position of the stage in m; NaN before the first
    y: float = math.nan  # of the platform
    unreferenced: str = ""  # why x is not counted from its reference; empty if it is
    stage: StageState = StageState()  # its motion; the condition is empty while the driver does not report it
    still: bool = True  # the stage has not moved for a tenth of a second, or a longer time where its strokes are slow
    error: float = math.nan  # newest compensation error in m
    sliding_variable: float = math.nan  # newest, m/s
    stroke_error_pp: float = math.nan  # peak-to-peak error over the stage's last finished movement, m
    samples: int = 0  # samples that the controller has processed since its start
    lost_samples: int = 0  # samples that did not reach the controller since its start

    @property
    def missing(self) -> tuple[str, ...]:
        """Nodes that are not working, with their state, e.g. ``logger (absent)``."""
        return tuple(f"{name} ({state})" for name, state in self.nodes.items() if state not in _WORKING)

    @property
    def starting(self) -> bool:
        """Whether a node is busy with its start, which a loaded machine makes long."""
        return STARTING in self.nodes.values()

    @property
    def alone(self) -> bool:
        """Whether no node of the graph is seen at all."""
        return set(self.nodes.values()) <= {ABSENT}

    @property
    def fault(self) -> str:
        """All faults in one line; empty without any."""
        return "; ".join(f"{node}: {text}" for node, text in self.faults.items())

    @property
    def absence(self) -> str:
        """Which nodes are not working, or that no samples arrive; empty if all is well."""
        if self.missing:
            return f"nodes that do not work: {', '.join(self.missing)}"
        return "" if self.fresh else "no samples come in"

    @property
    def contradiction(self) -> str:
        """Which nodes have which descriptions of the stage, if these differ; empty if not."""
        if len(set(self.descriptions.values())) < 2:
            return ""
        found = ", ".join(f"{node} {description}" for node, description in sorted(self.descriptions.items()))
        return f"the nodes' descriptions of the stage differ ({found}): start all with one stage file"

    @property
    def occupied(self) -> str:
        """That commissioning is at work, and at what; empty if not."""
        return f"the machine is being commissioned: {self.commissioning}" if self.commissioning else ""

    @property
    def at_rest(self) -> bool:
        """Whether the stage stands, and its motion has ended."""
        return self.still and self.stage.condition == "rest"

    @property
    def stands(self) -> bool:
        """Whether the stage stands and will not move by itself: it is held, or its motion has ended."""
        return self.still and self.stage.condition in ("rest", "held")

    @property
    def obstacle(self) -> str:
        """Why a cycle cannot start now; empty if it can."""
        unrecorded = f"not recorded: {', '.join(self.unrecorded)}" if self.unrecorded else ""
        # Another client's motion pauses.
        motion = "" if self.still and self.stage.condition != "moving" else "the stage moves"
        return self.occupied or self.fault or self.absence or self.contradiction or unrecorded or motion


class StrokeErrors:
    """Peak-to-peak error over each movement, from the streams of position and error.

    Errors belong to movements by their stamps: on a busy computer whole movements come at once, or an error before the
    position of its time. A tenth of a second at either end of a movement may be counted or not.

    Attributes:
        still: the stage is at rest.
        rest: way in m and time in s; the stage rests if it has moved by less in that time.
    """

    def __init__(self) -> None:
        self.still = True
        self.expect(math.inf, 0.0)
        self._positions: deque[tuple[int, float]] = deque()
        self._errors: deque[tuple[int, float]] = deque(maxlen=_WAITING)
        """Those that are newer than the newest position."""
        self._movements: deque[_Movement] = deque(maxlen=_MOVEMENTS)

    @property
    def last_pp(self) -> float:
        """Error over the last finished movement in m; NaN without one, or without an error of its time."""
        finished = [one.highest - one.lowest for one in self._movements if one.end_ns < math.inf]
        return finished[-1] if finished and finished[-1] >= 0.0 else math.nan

    def expect(self, speed: float, count: float) -> None:
        """Expect strokes of ``speed`` (m/s), seen by an encoder with this ``count`` (m)."""
        least, way = _LEAST_COUNTS * count, 0.5 * speed
        seconds = min(max(_LOOK_BACK_S, least / way), _LONGEST_LOOK_BACK_S)
        self._look_back_ns = round(seconds * 1e9)
        self._begins = min(_STILL_M, max(way * seconds, least))
        self._ends = self._begins if self._begins == _STILL_M else 0.5 * self._begins
        self.rest = self._ends, seconds

    def add(self, positions: Iterable[tuple[int, float]], errors: Iterable[tuple[int, float]]) -> None:
        """Add positions of the stage and compensation errors, each with its stamp in ns, in m."""
        for stamp_ns, x in positions:
            self._add_position(stamp_ns, x)
        self._errors.extend(errors)
        newest_ns = self._positions[-1][0] if self._positions else -math.inf
        while self._errors and self._errors[0][0] <= newest_ns:
            self._add_error(*self._errors.popleft())

    def _add_position(self, stamp_ns: int, x: float) -> None:
        positions = self._positions
        if positions and stamp_ns <= positions[-1][0]:
            # The source restarted: its earlier positions are meaningless now.
            positions.clear()
            self._errors.clear()
            self._movements.clear()
        positions.append((stamp_ns, x))
        # One that is older stays: where samples are missing the stage has not stopped.
        while len(positions) > 1 and stamp_ns - positions[1][0] >= self._look_back_ns:
            positions.popleft()
        still = abs(x - positions[0][1]) < (self._begins if self.still else self._ends)
        if self.still and not still:
            self._movements.append(_Movement(stamp_ns))
        elif still and not self.still and self._movements:
            self._movements[-1].end_ns = stamp_ns
        self.still = still

    def _add_error(self, stamp_ns: int, error: float) -> None:
        of = next((one for one in reversed(self._movements) if one.begin_ns < stamp_ns), None)
        if of and stamp_ns <= of.end_ns and math.isfinite(error):
            of.lowest, of.highest = min(of.lowest, error), max(of.highest, error)


@dataclass
class _Movement:
    begin_ns: int
    end_ns: float = math.inf
    lowest: float = math.inf
    highest: float = -math.inf
