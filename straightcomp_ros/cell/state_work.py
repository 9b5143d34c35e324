"""The work of each state of the cell: what is asked of the graph in it, and when it is done.

The work of a state is the generator with its name, e.g. `_starting`. Each tick advances it once. It returns when the
work is done, and raises if it cannot be done.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import State
from straightcomp_ros.cell.stage_movements import StageMovements
from straightcomp_ros.model.motion import MotionParameters, Waypoint

_ASK_AGAIN_S = 0.5
_HEARD_S = 0.3
_SETTLE_S = 1.5
"""A node that has just started needs about one more second to allocate and connect, and loses messages meanwhile."""
_HOME_S = 1.0
"""Time for the reference to fade to the middle or back to the map, and for the platform to follow."""
_OFF_WITHIN_S = 2.0
"""A driver that has not switched off within this time has failed; its machine's own watchdog has switched off."""
_REPORTED_WITHIN_S = 1.5
"""Within this time the diagnostics show what nodes do: a new fault, that a fault is gone, another description."""
Answer = Callable[[str], None]
"""Called with the reason for a refusal; an empty text means success."""


class Machine(Protocol):
    """What the sequence requests from the graph. No call waits; the next observations show the effect."""

    refusal: str  # why the last switch_on was refused; empty before the answer, and after success
    obstacle: str  # why the stage cannot be moved; empty if it can

    def activate(self) -> None: ...
    def switch_on(self) -> None: ...
    def switch_off(self) -> None: ...
    def reset_faults(self) -> None: ...
    def move(self, waypoints: Sequence[Waypoint]) -> None: ...
    def reload_map(self, then: Answer) -> None: ...
    def center(self, middle: bool, then: Answer) -> None: ...


class WorkFailed(Exception):
    """The work of a state cannot be done; the message gives the reason."""


class StateWork:
    """What the states do, on ``machine``; other arguments as of the sequence.

    Attributes:
        seen: the graph as of this tick; ``now`` the time of it, and ``since`` that of the state's beginning, s.
        movements: of the stage since the last Start.
        centred: the reference is in the middle of the travel, or was requested to go there.
    """

    def __init__(
        self,
        machine: Machine,
        motion: MotionParameters,
        start_timeout: float,
        now: float,
        *,
        as_one: bool,
        home: bool,
    ) -> None:
        self._machine, self._start_timeout, self._home = machine, start_timeout, home
        # A single trajectory contains its own rest at the end.
        self._settled, self._settle = as_one, 0.0 if as_one else motion.settle
        self.movements = StageMovements(motion, as_one)
        self.centred = False
        self.seen, self.now, self.since = Observation(), now, now
        self._asked = -math.inf

    def of(self, state: State, since: float) -> Iterator[None]:
        """The work of a state that begins at ``since``; without an end for one that waits for a command."""
        self.since, self._asked = since, -math.inf
        work: Iterator[None] = getattr(self, f"_{state.name.lower()}", lambda: iter(()))()
        return work

    def recover(self, work: Iterator[None], done: Callable[[], None]) -> Iterator[None]:
        """Clear the fault and switch on again, then go on with the interrupted ``work``; calls ``done()`` between."""
        yield from self._clearing(0.0)
        yield from self._switching_on()
        done()
        yield from work

    def _resetting(self) -> Iterator[None]:
        ready_since = self.now
        while True:
            obstacle = self.seen.obstacle or self._machine.obstacle
            if self.seen.occupied:
                raise WorkFailed(self.seen.occupied)
            if self.seen.contradiction and self._overdue(_REPORTED_WITHIN_S):
                raise WorkFailed(self.seen.contradiction)
            if obstacle:
                ready_since = self.now
                if self._overdue(self._start_timeout):
                    raise WorkFailed(f"not ready: {obstacle}")
                # First hear whether somebody else uses the machine.
                if self.seen.missing and self._overdue(_HEARD_S) and self._due():
                    self._machine.activate()
            elif self._due():
                # Another client may have left the reference in the middle. Retried if refused during another change.
                self._machine.center(False, self._back_on_the_map)
            if self.now - ready_since >= _SETTLE_S:
                return
            yield

    def _back_on_the_map(self, refusal: str) -> None:
        self.centred = self.centred and bool(refusal)

    def _starting(self) -> Iterator[None]:
        yield from self._switching_on()
        # In lockstep no time passes before the motion, so the platform cannot be homed.
        for middle in (True, False) if self._home and self.seen.stamp_ns else ():
            answers: list[str] = []
            self._machine.center(middle, answers.append)
            asked = self.now
            while not answers or self.now - asked < _HOME_S:
                if any(answers) or self.now - asked > self._start_timeout:
                    raise WorkFailed(f"homing: {'; '.join(answers) or 'the feedforward does not answer'}")
                yield

    def _execute(self) -> Iterator[None]:
        moves = self.movements
        while True:
            if moves.strokes and self._arrived():
                if moves.strokes_done >= moves.strokes:
                    return
                self._machine.move(moves.next(self.seen, self.now))
            yield

    def _arrived(self) -> bool:
        return self.movements.arrived(self.seen, self.now)

    def _holding(self) -> Iterator[None]:
        while not (self._arrived() and self.seen.still):
            yield

    def _completing(self) -> Iterator[None]:
        # The stage's last movement has ended; another client may still be moving the stage.
        while not (self._arrived() and (self._settled or self.seen.still) and self._overdue(self._settle)):
            yield
        yield from self._switching_off()

    def _stopping(self) -> Iterator[None]:
        # Without samples the end of the movement cannot be seen.
        while self.seen.fresh and not self._arrived():
            yield
        yield from self._switching_off()

    def _aborting(self) -> Iterator[None]:
        # The stage keeps its trajectory and comes to rest at the end of its movement.
        self.movements.forget()
        for _ in self._switching_off():
            if self._overdue(_OFF_WITHIN_S):
                return
            yield

    def _clearing(self, least: float = _REPORTED_WITHIN_S) -> Iterator[None]:
        yield from self._asking(
            self._machine.reset_faults,
            lambda: not self.seen.faults and self._overdue(least),
            lambda: f"the fault remains: {self.seen.fault}",
        )

    def _switching_on(self) -> Iterator[None]:
        yield from self._asking(
            self._machine.switch_on,
            lambda: self.seen.amplifier_on,
            lambda: f"the driver refuses to enable: {self._machine.refusal or 'no answer'}",
        )

    def _switching_off(self) -> Iterator[None]:
        while self.seen.amplifier_on:
            if self._due():
                self._machine.switch_off()
            yield

    def _asking(self, ask: Callable[[], None], done: Callable[[], bool], why: Callable[[], str]) -> Iterator[None]:
        """Repeat a request until it is done; fails after the start timeout with the text of ``why``."""
        end, self._asked = self.now + self._start_timeout, -math.inf
        while not done():
            if self.now > end:
                raise WorkFailed(why())
            if self._due():
                ask()
            yield

    def _due(self) -> bool:
        """Whether to send the request (again) now."""
        if due := self.now - self._asked >= _ASK_AGAIN_S:
            self._asked = self.now
        return due

    def _overdue(self, seconds: float) -> bool:
        return self.now - self.since > seconds
