"""The sequencer of the stage's cycle: PackML's state machine, run by the cell node and by the OPC UA gateway.

The work of each state is a generator, advanced once in each tick: it returns when the work is done and raises when it
cannot be done.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import ACCEPTED, DONE, FAILED, Command, Order, State, name, refusal
from straightcomp_ros.model.stage import MotionParameters, Waypoint, cycles, trapezoid

_ASK_AGAIN_S = 0.5
_SETTLE_S = 1.5
"""A node that has just come up allocates and connects for about a second more, and loses messages meanwhile."""
_HOME_S = 1.0
"""Time that the reference takes to the middle, or back to the map, and the platform to follow."""
_OFF_WITHIN_S = 2.0
"""A driver that has not switched off by then is dead or deaf; its machine's own watchdog has switched off."""
_REPORTED_WITHIN_S = 1.5
"""A fault that is there, or one that is gone, shows in the diagnostics by then."""
_ARRIVE_WITHIN_S = 5.0
_ARRIVED_M = 10e-6
_ARRIVED_SHARE = 0.9995
"""Of a movement's time: in lockstep no sample need follow the one that ends the motion."""
_NS = 1e9
MOST_STROKES = 1_000_000
_WITHOUT_AMPLIFIER = (State.STOPPED, State.ABORTING, State.ABORTED, State.CLEARING)
_WITH_AMPLIFIER = (State.EXECUTE, State.HOLDING, State.HELD, State.UNHOLDING)
Answer = Callable[[str], None]
"""Takes why something was refused, or an empty text."""


class Machine(Protocol):
    """What the sequence asks of the graph. Nothing here waits; answers show in the next observations."""

    refusal: str  # why the last switch_on was refused; empty while it is not answered, and when it was done
    obstacle: str  # why the stage could not be moved; empty where it can

    def activate(self) -> None:
        """Bring up all nodes that have a lifecycle."""

    def switch_on(self) -> None:
        """Ask for the amplifier."""

    def switch_off(self) -> None:
        """Switch the amplifier off."""

    def reset_faults(self) -> None:
        """Clear latched faults."""

    def move(self, waypoints: Sequence[Waypoint]) -> None:
        """Move the stage, starting when this arrives."""

    def reload_map(self, then: Answer) -> None:
        """Read the map's file again."""

    def center(self, middle: bool, then: Answer) -> None:
        """Take the reference to the middle of the travel, or back to the map."""


class _Failed(Exception):
    """The work of a state cannot be done; the message says why."""


class _Movement(NamedTuple):
    """A movement under way: stamp of the sample before it (0: none), duration, goal in m, latest arrival (clock)."""

    stamp_ns: int
    duration_ns: int
    goal: float
    latest: float


class CellSequence:
    """State machine of the cell.

    Args:
        machine: what acts.
        motion: of each stroke.
        start_timeout: longest Resetting, Starting, Clearing or step of a recovery, s.
        clock: monotonic time, s.
        as_one: all strokes are one trajectory, whose times the driver keeps; else the stage is sent each movement when
            the one before has ended, so that the cycle can be held and stopped between them.
        home: before the first stroke, bring the platform to the middle of its travel, then back onto the map.
        recoveries: how often the amplifier is switched on again after it went off in Execute.

    Attributes:
        state: present state.
        message: why the state is what it is, or why the last command was refused.
        strokes: that the last Start asked for, each forward and back; 0 compensates until Complete or Stop.
        strokes_done: of these.
        centred: the reference is in the middle of the travel, or has been asked to go there.
        recovered: how often the amplifier was switched on again since the start.
    """

    def __init__(
        self,
        machine: Machine,
        motion: MotionParameters,
        start_timeout: float,
        clock: Callable[[], float] = time.monotonic,
        *,
        as_one: bool = False,
        home: bool = False,
        recoveries: int = 0,
    ) -> None:
        self._machine, self._motion, self._start_timeout, self._clock = machine, motion, start_timeout, clock
        self._as_one, self._home, self._recoveries = as_one, home, recoveries
        self.strokes = self.strokes_done = self.recovered = 0
        self.centred = False
        self._seen = Observation()
        self._movement: _Movement | None = None
        self._movements = 0
        self._now = clock()
        self._works: dict[State, Callable[[], Iterator[None]]] = {
            State.RESETTING: self._resetting,
            State.STARTING: self._starting,
            State.EXECUTE: self._execute,
            State.HOLDING: self._holding,
            State.COMPLETING: self._completing,
            State.STOPPING: self._stopping,
            State.ABORTING: self._aborting,
            State.CLEARING: self._clearing,
        }
        self._enter(State.STOPPED, "")

    @property
    def at_work(self) -> bool:
        """The amplifier is, or is about to be, on because of this."""
        return self.state in ACCEPTED[Command.STOP] or self.state is State.STOPPING

    @property
    def progress(self) -> float:
        """Fraction of the present movement's time that has passed by the newest sample; 0 without a movement."""
        if self._movement is None:
            return 0.0
        # In lockstep there is no sample before the movement.
        begin_ns = self._movement.stamp_ns or self._seen.first_ns
        return (self._seen.stamp_ns - begin_ns) / max(self._movement.duration_ns, 1)

    def command(self, command: Command, strokes: int = 0) -> str:
        """Take a command, with the number of ``strokes`` for Start; returns why it is refused, or an empty text."""
        reason = refusal(command, self.state)
        if not reason and command is Command.START and not 0 <= strokes <= MOST_STROKES:
            reason = f"strokes {strokes} is out of range; allowed: 0 to {MOST_STROKES}"
        to_be_run = {Command.START: strokes, Command.UNHOLD: self.strokes}.get(command, 0)
        if not reason and self.centred and to_be_run:
            reason = f"{name(command)} is not accepted while the reference is in the middle; call Center(false) before"
        if reason:
            self.message = reason
            return reason
        if command is Command.START:
            self.strokes, self.strokes_done, self._movements, self._movement = strokes, 0, 0, None
        self._enter(ACCEPTED[command][self.state], f"command {name(command)}")
        return ""

    def order(self, order: Order, middle: bool, then: Answer) -> None:
        """Ask for another reference.

        Args:
            order: what is asked.
            middle: for Center: to the middle of the travel; false: back to the map.
            then: gets why it is refused, or an empty text, now or when the node has answered.
        """
        reason = refusal(order, self.state)
        if not reason and order is Order.CENTER and middle and self.state is State.EXECUTE and self.strokes:
            reason = "Center(true) is not accepted while strokes are run; accepted after Hold, or with 0 strokes"
        if reason:
            self.message = reason
            then(reason)
            return
        state, before = self.state, self.centred

        def answered(refusal: str) -> None:
            if order is Order.CENTER:
                self.centred = before if refusal else middle
            if self.state is state:
                self.message = refusal or f"command {order.value}"
            then(refusal)

        if order is Order.RELOAD_MAP:
            self._machine.reload_map(answered)
        else:
            # No stroke is to begin before the answer.
            self.centred = before or middle
            self._machine.center(middle, answered)

    def tick(self, seen: Observation) -> None:
        """Go on, with the graph as it is ``seen`` now."""
        self._now, self._seen = self._clock(), seen
        trouble = "" if self._recovering else self._trouble(seen)
        if trouble and self._recoverable(seen):
            self.recovered += 1
            self._recovering, self._work = True, self._recover(self._work)
        elif trouble:
            self._enter(State.ABORTING, trouble)
        try:
            next(self._work)
        except StopIteration:
            if self.state in DONE:
                self._enter(DONE[self.state], self.message)
        except _Failed as failure:
            self._enter(FAILED[self.state], str(failure))

    def _enter(self, state: State, message: str) -> None:
        self.state, self.message, self._since = state, message, self._clock()
        self._asked, self._recovering = -math.inf, False
        self._work = self._works[state]() if state in self._works else iter(())
        if state is State.ABORTING:
            self._machine.switch_off()

    def _trouble(self, seen: Observation) -> str:
        # In Stopped the graph may be somebody else's: its faults show as alarms, and are none of ours.
        if self.state in _WITHOUT_AMPLIFIER:
            return ""
        if seen.fault or self.state in (State.RESETTING, State.STOPPING, State.COMPLETE):
            return seen.fault
        if seen.missing or not seen.fresh:
            return seen.absence
        return "the amplifier went off" if self.state in _WITH_AMPLIFIER and not seen.amplifier_on else ""

    def _recoverable(self, seen: Observation) -> bool:
        """Whether this trouble is an amplifier that is off, and may be switched on again."""
        allowed = self.state is State.EXECUTE and self.recovered < self._recoveries
        return allowed and seen.fresh and not seen.missing and not seen.amplifier_on

    def _recover(self, work: Iterator[None]) -> Iterator[None]:
        yield from self._asking(
            self._machine.reset_faults, lambda: not self._seen.faults, lambda: f"the fault remains: {self._seen.fault}"
        )
        yield from self._switching_on()
        self._recovering = False
        yield from work

    def _resetting(self) -> Iterator[None]:
        ready_since = self._now
        while True:
            obstacle = self._seen.obstacle or self._machine.obstacle
            if obstacle:
                ready_since = self._now
                if self._overdue(self._start_timeout):
                    raise _Failed(f"not ready: {obstacle}")
                if self._seen.missing and self._due():
                    self._machine.activate()
            else:
                if self._due():
                    # Wherever it was left, by whomever. Refused while it is on its way: then again.
                    self._machine.center(False, self._back_on_the_map)
                if self._now - ready_since >= _SETTLE_S:
                    return
            yield

    def _back_on_the_map(self, refusal: str) -> None:
        self.centred = self.centred and bool(refusal)

    def _starting(self) -> Iterator[None]:
        yield from self._switching_on()
        # In lockstep no time passes before the motion.
        if self._home and self._seen.stamp_ns:
            yield from self._homing()

    def _homing(self) -> Iterator[None]:
        for middle in (True, False):
            answers: list[str] = []
            self._machine.center(middle, answers.append)
            asked = self._now
            while not answers or self._now - asked < _HOME_S:
                if any(answers):
                    raise _Failed(f"homing: {answers[0]}")
                if self._now - asked > self._start_timeout:
                    raise _Failed("homing: the feedforward does not answer")
                yield

    def _switching_on(self) -> Iterator[None]:
        yield from self._asking(
            self._machine.switch_on,
            lambda: self._seen.amplifier_on,
            lambda: f"the driver refuses to enable: {self._machine.refusal or 'no answer'}",
        )

    def _execute(self) -> Iterator[None]:
        while self.strokes == 0:
            yield
        yield from self._arriving()
        while self.strokes_done < self.strokes:
            self._start_movement()
            yield
            yield from self._arriving()

    def _start_movement(self) -> None:
        seen = self._seen
        if self._as_one:
            waypoints = cycles(self._motion, self.strokes)
        else:
            waypoints = movement(self._motion, seen.x, self._movements)
        duration_ns = waypoints[-1].time_ns
        latest = self._now + duration_ns / _NS + _ARRIVE_WITHIN_S
        self._movement = _Movement(seen.stamp_ns, duration_ns, waypoints[-1].position, latest)
        self._machine.move(waypoints)

    def _arriving(self) -> Iterator[None]:
        """Until no movement of ours is under way; counts one that ends."""
        while self._movement is not None:
            seen, goal = self._seen, self._movement.goal
            there = self._as_one or (seen.still and abs(seen.x - goal) < _ARRIVED_M)
            if there and self.progress > _ARRIVED_SHARE:
                self._movement = None
                self._movements += 1
                self.strokes_done = self.strokes if self._as_one else self._movements // 2
            elif not self._as_one and self._now > self._movement.latest and seen.still:
                self._movement = None
                raise _Failed(f"the stage did not arrive at {goal:.6f} m; it stands at {seen.x:.6f} m")
            else:
                yield

    def _holding(self) -> Iterator[None]:
        yield from self._arriving()
        while not self._seen.still:
            yield

    def _completing(self) -> Iterator[None]:
        yield from self._arriving()
        # The stage's last movement is over; a stage that others move may still be on its way.
        while not self._as_one and not (self._seen.still and self._overdue(self._motion.settle)):
            yield
        yield from self._switching_off()

    def _stopping(self) -> Iterator[None]:
        for _ in self._arriving():
            # Where no samples come in, nothing tells of the movement any more.
            if not self._seen.fresh:
                break
            yield
        yield from self._switching_off()

    def _aborting(self) -> Iterator[None]:
        # What the stage was told stays told: it comes to rest where its movement ends.
        self._movement = None
        for _ in self._switching_off():
            if self._overdue(_OFF_WITHIN_S):
                return
            yield

    def _clearing(self) -> Iterator[None]:
        yield from self._asking(
            self._machine.reset_faults,
            lambda: not self._seen.faults and self._overdue(_REPORTED_WITHIN_S),
            lambda: f"the fault remains: {self._seen.fault}",
        )

    def _switching_off(self) -> Iterator[None]:
        while self._seen.amplifier_on:
            if self._due():
                self._machine.switch_off()
            yield

    def _asking(self, ask: Callable[[], None], done: Callable[[], bool], why: Callable[[], str]) -> Iterator[None]:
        """Ask again and again until it is done; fails after the start timeout with what ``why`` says."""
        end, self._asked = self._now + self._start_timeout, -math.inf
        while not done():
            if self._now > end:
                raise _Failed(why())
            if self._due():
                ask()
            yield

    def _due(self) -> bool:
        """Whether to ask (again) now."""
        if self._now - self._asked < _ASK_AGAIN_S:
            return False
        self._asked = self._now
        return True

    def _overdue(self, seconds: float) -> bool:
        return self._now - self._since > seconds


def movement(motion: MotionParameters, here: float, number: int) -> list[Waypoint]:
    """Movement ``number`` (from 0) of a cycle from ``here`` (m): a rest and a move, even ones forward, odd ones back.

    Only the rest where the stage is there already.
    """
    rest = motion.pause if number else motion.settle
    goal = motion.start + (0.0 if number % 2 else motion.stroke)
    points = [Waypoint(0, here, 0.0), Waypoint(round(rest * _NS), here, 0.0)]
    return [*points, *trapezoid(points[-1], goal, motion.speed, motion.acceleration)]
