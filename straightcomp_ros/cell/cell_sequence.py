"""The sequencer of the stage's cycle: PackML's state machine, the work of its states, and the stage's movements.

The cell node and the OPC UA gateway run it. The work of a state is the generator of :class:`CellSequence` with its
name, e.g. `_starting`. Each tick advances it once. It returns when the work is done, and raises if it cannot be done.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import NamedTuple, NoReturn, Protocol

from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import ACCEPTED, DONE, FAILED, Command, Order, State, name, refusal
from straightcomp_ros.messages.joint_trajectory import MOST_POINTS
from straightcomp_ros.model.motion import MotionParameters, Waypoint, cycles, forward_and_back, goals, jog, move
from straightcomp_ros.model.paced_motion import ARRIVED_M, AT_START_M
from straightcomp_ros.parameters.declaration import ParameterError

MOST_STROKES = 1_000_000
AMPLIFIER_OFF = "the amplifier went off"
_BEGINNING = (Command.RESET, Command.START)
_WITHOUT_AMPLIFIER = (State.STOPPED, State.ABORTING, State.ABORTED, State.CLEARING)
_WITH_AMPLIFIER = (State.EXECUTE, State.HOLDING, State.HELD, State.UNHOLDING)
_AT_WORK = (State.STARTING, *_WITH_AMPLIFIER, State.COMPLETING, State.STOPPING, State.ABORTING)
_ASK_AGAIN_S = 0.5
_RECEIVED_S = 0.3
_SETTLE_S = 1.5
"""A node that has just started needs about one more second to allocate and connect, and loses messages meanwhile."""
_STARTED_WITHIN_S = 600.0
"""Longest wait for a node that runs and is starting: with an empty cache on a busy machine it compiles for 40 s or
more."""
_HOME_S = 1.0
"""Time for the reference to fade to the middle or back to the map, and for the platform to follow."""
_OFF_WITHIN_S = 2.0
"""A driver that has not switched off within this time has failed; its machine's own watchdog has switched off."""
_REPORTED_WITHIN_S = 1.5
"""Within this time the diagnostics show what nodes do: a new fault, that a fault is gone, another description."""
_ARRIVE_WITHIN_S = 5.0
_POINTS_TO_START = 8
"""Most points of the way to the start of a trajectory: of a move with a limit of the jerk."""
_FARTHEST_JOG_UM = 20_000_000
_ARRIVED_SHARE = 0.9995
"""Fraction of a movement's time: in lockstep the last sample may come before the end of the motion."""
_NS = 1e9
Answer = Callable[[str], None]
"""Called with the reason for a refusal; an empty text means success."""


class Machine(Protocol):
    """What the sequence requests from the graph. No call waits; the next observations show the effect."""

    obstacle: str  # why the stage cannot be moved; empty if it can

    def activate(self) -> None: ...
    def move(self, waypoints: Sequence[Waypoint]) -> None: ...
    def override(self, fraction: float, then: Answer) -> None: ...
    def request(self, service: str, on: bool | None = None, then: Answer = ...) -> None: ...


class WorkFailed(Exception):
    """The work of a state cannot be done; the message gives the reason."""


def check_strokes(motion: MotionParameters, strokes: int) -> None:
    """ParameterError if the trajectory of so many strokes, as one, has more points than the driver takes."""
    each = len(forward_and_back(motion)) - 1
    most = (MOST_POINTS - _POINTS_TO_START) // each
    if strokes > most:
        raise ParameterError(
            f"parameter 'strokes': {strokes} with {each} points each ('stage.motion.steps', 'file', 'jerk') are no one "
            f"trajectory of at most {MOST_POINTS} points; allowed: <= {most}"
        )


class StageMovements:
    """The movements of the stage in a cycle by ``motion``; a stroke is a whole cycle of it.

    With ``as_one`` all strokes are one trajectory, timed by the driver; otherwise the stage gets one movement after the
    other, and needs no time in common with the driver. ``count`` (m) is that of the encoder of x. ParameterError: the
    file of positions is refused.
    """

    strokes: int  # requested
    strokes_done: int

    def __init__(self, motion: MotionParameters, as_one: bool, count: float = 0.0) -> None:
        self._motion, self.as_one, self._goals = motion, as_one, goals(motion)
        self._near = ARRIVED_M + 0.5 * count
        self._begin_ns = self._duration_ns = self._stands_ns = self._before = 0
        self._goal = self._begun_by = 0.0
        self._own: int | None = None
        self.begin(0)

    def begin(self, strokes: int) -> None:
        """Begin another cycle."""
        self.strokes, self.strokes_done, self._number = strokes, 0, 0
        self.forget()

    def forget(self) -> None:
        """Stop following the current movement."""
        self._under_way = False

    @property
    def waits(self) -> bool:
        """Whether the driver has not begun the current movement yet."""
        return self._under_way and self._own is None

    def next(self, seen: Observation, now: float) -> Sequence[Waypoint]:
        """Waypoints of the next movement, which begins at ``now`` (clock, s).

        One by one they are a rest and a move, to each position in turn; only the rest if the stage is at its goal. A
        stage that stands elsewhere goes to the start first.
        """
        motion = self._motion
        if self.as_one:
            waypoints = cycles(motion, self.strokes)
            if abs(seen.x - motion.start) > AT_START_M:
                way = jog(motion, seen.x, motion.start - seen.x)
                end_ns = way[-1].time_ns
                waypoints = [*way, *(point._replace(time_ns=point.time_ns + end_ns) for point in waypoints[1:])]
        else:
            rest = motion.pause if self._number else motion.settle
            goal = self._goals[self._number % len(self._goals)]
            waypoints = [Waypoint(0, seen.x, 0.0), Waypoint(round(rest * _NS), seen.x, 0.0)]
            waypoints += move(waypoints[-1], goal, motion.speed, motion.acceleration, motion.jerk)
        self._duration_ns, self._goal, _ = waypoints[-1]
        self._begin_ns, self._stands_ns, self._begun_by = seen.stamp_ns, 0, now + _ARRIVE_WITHIN_S
        # Numbers of the motion before, and of this one once the driver has begun it.
        self._before, self._own, self._under_way = seen.stage.number, None, True
        return waypoints

    def progress(self, seen: Observation) -> float:
        """Fraction of the movement's time elapsed at the newest sample; 0 without a movement."""
        if not self._under_way:
            return 0.0
        # In lockstep there is no sample before the movement.
        return (seen.stamp_ns - seen.stage.behind_ns - (self._begin_ns or seen.first_ns)) / max(self._duration_ns, 1)

    def arrived(self, seen: Observation, now: float) -> bool:
        """Whether no movement is running; counts one that has just ended. One that is held is running.

        WorkFailed: the driver has not begun the movement within 5 s, or has begun another one; it was ended on its way;
        or it is over, and the samples of 5 s show the stage elsewhere.
        """
        if not self._under_way:
            return True
        if self._own is None and seen.stage.number != self._before:
            self._own = seen.stage.number
        if self.waits:
            if now > self._begun_by:
                raise WorkFailed("the driver did not begin the motion of the stage; its log says why")
            return False
        if seen.stage.number != self._own:
            self._fail("another client has begun a motion of the stage")
        if seen.stage.ended:
            self._fail(f"another client has ended the motion of the stage, which stands at {seen.x:.6f} m")
        delayed = seen.stage.behind_ns or seen.stage.condition in ("stopping", "held")
        over = not delayed and self.progress(seen) > _ARRIVED_SHARE
        if over and abs(seen.x - self._goal) < self._near and (seen.still or self.as_one):
            self.forget()
            self._number += 1
            self.strokes_done = self.strokes if self.as_one else self._number // len(self._goals)
        elif seen.at_rest:
            # In time of the samples: on a busy computer the last ones come long after the report of the end.
            self._stands_ns = self._stands_ns or seen.stamp_ns
            if seen.stamp_ns > self._stands_ns + _ARRIVE_WITHIN_S * _NS:
                self._fail(f"the stage did not arrive at {self._goal:.6f} m; it stands at {seen.x:.6f} m")
        else:
            self._stands_ns = 0
        return not self._under_way

    def _fail(self, reason: str) -> NoReturn:
        self.forget()
        raise WorkFailed(reason)


class _Jog(NamedTuple):
    """One that is asked for: the number of the motion before, until when it must have begun, and who waits."""

    before: int
    until: float
    answered: Answer


@dataclass(eq=False)
class CellSequence:
    """State machine of the cell."""

    machine: Machine
    motion: MotionParameters
    start_timeout: float  # longest time in Resetting, Starting, Clearing, or a step of a recovery, s
    clock: Callable[[], float] = time.monotonic
    _: KW_ONLY
    as_one: bool = False  # all strokes are one trajectory; see StageMovements
    home: bool = False  # before the first stroke, move the platform to the middle of its travel, then back to the map
    count: float = 0.0  # of the encoder of x, m
    recoveries: int = 0  # how often to switch the amplifier on again after it went off in Execute

    def __post_init__(self) -> None:
        # Of the stage since the last Start; with 0 strokes, Execute compensates until Complete or Stop.
        self.movements = StageMovements(self.motion, self.as_one, self.count)
        self.seen, self.now = Observation(), self.clock()  # the graph as of this tick, and its time in s
        self.recovered = 0  # number of times that the amplifier was switched on again
        self.centred = False  # the reference is in the middle of the travel, or was requested to go there
        self._named = False
        self._jog: _Jog | None = None
        self._enter(State.STOPPED, "")

    @property
    def at_work(self) -> bool:
        """Whether the sequence may have the amplifier on."""
        return self.state in _AT_WORK

    @property
    def progress(self) -> float:
        """Elapsed fraction of the current movement's time; 0 without a movement."""
        return self.movements.progress(self.seen)

    def command(self, command: Command, strokes: int = 0) -> str:
        """Execute a command, with the number of ``strokes`` for Start; returns the reason for a refusal, or ``""``."""
        reason = refusal(command, self.state) or (self.seen.occupied if command in _BEGINNING else "")
        to_be_run = {Command.START: strokes, Command.UNHOLD: self.movements.strokes}.get(command, 0)
        if not reason and not 0 <= to_be_run <= MOST_STROKES:
            reason = f"strokes {strokes} is out of range; allowed: 0 to {MOST_STROKES}"
        elif not reason and self.centred and to_be_run:
            reason = f"{name(command)} is not accepted while the reference is in the middle; call Center(false) first"
        if reason:
            self.message = reason
            return reason
        if command is Command.START:
            self.movements.begin(strokes)
        recovering = self._recovering
        self._enter(ACCEPTED[command][self.state], f"command {name(command)}")
        if recovering and command is Command.HOLD:
            # The stage goes on during a recovery: it is held at once, and the recovery goes on.
            self.machine.request("driver/hold", True)
            self._recovering, self._work = True, self._recover(self._work)
        return ""

    def order(self, order: Order, argument: int, then: Answer) -> None:
        """Request another reference, or another motion of the stage.

        ``argument`` is with Center whether it is the reference of the middle of the travel (1) or of the map (0), with
        Override the speed in %, and with Jog the distance in µm. ``then`` is called with the reason for a refusal, or
        an empty text, now or when the node has answered.
        """
        middle = bool(argument) and order is Order.CENTER
        if reason := refusal(order, self.state) or self._order_refusal(order, argument):
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
            self.machine.request("feedforward/reload_map", then=answered)
        elif order is Order.OVERRIDE:
            self.machine.override(argument * 1e-2, answered)
        elif order is Order.JOG:
            self._jog = _Jog(self.seen.stage.number, self.clock() + _REPORTED_WITHIN_S, answered)
            self.machine.move(jog(self.motion, self.seen.x, argument * 1e-6))
        else:
            # No stroke may begin before the answer.
            self.centred = before or middle
            self.machine.request("feedforward/center", middle, answered)

    def _order_refusal(self, order: Order, argument: int) -> str:
        strokes = self.state is State.EXECUTE and self.movements.strokes
        if order is Order.CENTER and argument and strokes:
            return "Center(true) is not accepted while strokes are run; accepted after Hold, or with 0 strokes"
        if order is Order.OVERRIDE and not 0 <= argument <= 100:
            return f"override {argument} % is out of range; allowed: 0 to 100 %"
        if order is Order.JOG:
            if strokes:
                return "Jog is not accepted while strokes are run; accepted in Execute with 0 strokes"
            if self._jog or not self.seen.at_rest:
                return "Jog is not accepted while the stage moves"
            if self.centred or not 0 < abs(argument) <= _FARTHEST_JOG_UM:
                return f"Jog by {argument} µm; allowed: 1 to {_FARTHEST_JOG_UM} either way, with the map's reference"
        return ""

    def tick(self, seen: Observation) -> None:
        """Continue with the graph as ``seen`` now."""
        self.now, self.seen = self.clock(), seen
        asked = self._jog
        if asked and (seen.stage.number != asked.before or self.now > asked.until):
            self._jog = None
            if late := seen.stage.number == asked.before:
                self.machine.request("driver/end_motion")
            asked.answered("the driver did not begin the jog; its log says why" if late else "")
        missing = seen.absence if seen.missing else ""
        # A machine whose controller has died cannot be switched on again.
        trouble = missing if self._recovering else self._trouble(seen)
        if missing and self.state in (State.ABORTING, State.ABORTED) and not self._named:
            # A fault is seen at once; that a node has died, which may be its cause, only when its heartbeats stop.
            self._named = True
            self.message = self.message if missing in self.message else f"{self.message}; {missing}"
        allowed = self.state is State.EXECUTE and self.recovered < self.recoveries
        if trouble and allowed and not seen.absence and not seen.amplifier_on:
            self.recovered += 1
            self._work = self._recover(self._work)
        elif trouble:
            self._enter(State.ABORTING, trouble)
        try:
            next(self._work)
        except StopIteration:
            if self.state in DONE:
                self._enter(DONE[self.state], self.message)
        except WorkFailed as failure:
            self._enter(FAILED[self.state], str(failure))

    def _enter(self, state: State, message: str) -> None:
        stopping = state is State.ABORTING and self.state in (State.STOPPING, State.HOLDING)
        self.state = state
        self.message = message  # reason for the state, or for the refusal of the last command
        self._named = state is State.ABORTED and self._named
        self.since = self.clock()  # when the state began, s
        self._asked, self._recovering = -math.inf, False
        # A state without work of its own waits for a command.
        self._work: Iterator[None] = getattr(self, f"_{state.name.lower()}", lambda: iter(()))()
        if state is State.ABORTING:
            self.machine.request("driver/enable", False)
            if self.movements.waits or self._jog or stopping:
                # It may be on its way to a driver that stands still now, or a fault came with a Stop or Hold.
                self.machine.request("driver/end_motion")

    def _trouble(self, seen: Observation) -> str:
        # In Stopped another client may use the graph: its faults are only shown as alarms.
        if self.state in _WITHOUT_AMPLIFIER:
            return ""
        if seen.occupied and self.state in (State.IDLE, State.COMPLETE):
            return seen.occupied
        if seen.fault or self.state in (State.RESETTING, State.STOPPING, State.COMPLETE):
            return seen.fault
        off = self.state in _WITH_AMPLIFIER and not seen.amplifier_on
        return seen.absence or (AMPLIFIER_OFF if off else "")

    def _recover(self, work: Iterator[None]) -> Iterator[None]:
        """Clear the fault and switch on again, then go on with the interrupted ``work``."""
        self._recovering = True
        yield from self._clearing(0.0)
        for _ in self._switching_on():
            # A fault now is another one, to be recovered from in its turn.
            self._recovering = not self.seen.fault
            yield
        self._recovering = False
        # Not inside this one: recoveries would nest.
        self._work = work
        yield

    def _resetting(self) -> Iterator[None]:
        ready_since, waits_since, waits_for, homes, asked = self.now, self.now, "", False, False
        while True:
            obstacle = self.seen.obstacle or self.machine.obstacle
            if not obstacle and self.seen.unreferenced:
                obstacle = f"x is not referenced: {self.seen.unreferenced}"
                if self.seen.stamp_ns and self._due():  # without a sample there may be no machine
                    if not asked:
                        # A hold that was left would hold the homing too. Once: a later hold is meant.
                        self.machine.request("driver/end_motion")
                    self.machine.request("driver/home")
                    asked = True
            if self.seen.occupied:
                raise WorkFailed(self.seen.occupied)
            if self.seen.contradiction and self._overdue(_REPORTED_WITHIN_S):
                raise WorkFailed(self.seen.contradiction)
            if obstacle != waits_for:
                # Once: the refusal of a command stays to be read.
                waits_for, self.message = obstacle, f"waits: {obstacle}" if obstacle else ""
            if obstacle:
                ready_since = self.now
                moves = self.seen.fresh and (self.seen.stage.condition == "moving" or not self.seen.still)
                # Until it stands again: from its index the stage goes to the start.
                homes = moves and (homes or bool(self.seen.unreferenced))
                if homes or (self.seen.starting and not self._overdue(_STARTED_WITHIN_S)):
                    waits_since = self.now
                if self.now - waits_since > self.start_timeout:
                    raise WorkFailed(f"not ready: {obstacle}")
                # First receive whether another client uses the machine.
                if self.seen.missing and self._overdue(_RECEIVED_S) and self._due():
                    self.machine.activate()
            elif self._due():
                # Another client may have left the reference in the middle. Retried if refused during another change.
                self.machine.request("feedforward/center", False, self._back_on_the_map)
                # And a motion held, which would go on when the stage is released.
                self.machine.request("driver/end_motion")
            if self.now - ready_since >= _SETTLE_S:
                break
            yield
        # A client that was killed has left it on.
        yield from self._switching_off()

    def _back_on_the_map(self, refusal: str) -> None:
        self.centred = self.centred and bool(refusal)

    def _starting(self) -> Iterator[None]:
        yield from self._switching_on()
        # In lockstep no time passes before the motion, so the platform cannot be homed.
        for middle in (True, False) if self.home and self.seen.stamp_ns else ():
            answers: list[str] = []
            self.machine.request("feedforward/center", middle, answers.append)
            asked = self.now
            while not answers or self.now - asked < _HOME_S:
                if any(answers) or self.now - asked > self.start_timeout:
                    raise WorkFailed(f"homing: {'; '.join(answers) or 'the feedforward does not answer'}")
                yield

    def _execute(self) -> Iterator[None]:
        moves = self.movements
        while True:
            if moves.strokes and moves.arrived(self.seen, self.now):
                if moves.strokes_done >= moves.strokes:
                    return
                self.machine.move(moves.next(self.seen, self.now))
            yield

    def _holding(self) -> Iterator[None]:
        # A machine that takes no such order is waited for, until its movement ends.
        while not (self._overdue(_RECEIVED_S) and self.seen.stands):
            if self._due():
                self.machine.request("driver/hold", True)
            yield

    def _unholding(self) -> Iterator[None]:
        answers = ["no answer"]

        def released() -> bool:
            # With an override of 0 % it stands as if it were held: only the driver's answer shows the difference.
            stands = answers[-1] if not self.seen.stage.override else self.seen.stage.condition in ("stopping", "held")
            return not stands and self._overdue(_RECEIVED_S)

        ask = partial(self.machine.request, "driver/hold", False, answers.append)
        yield from self._asking(ask, released, lambda: "the stage remains held")

    def _completing(self) -> Iterator[None]:
        moved = self.now
        while True:
            arrived = self.movements.arrived(self.seen, self.now)
            if arrived and self.as_one:  # its trajectory ends with the settling time
                break
            # Another client may be moving the stage, or pause; a jog may not have begun.
            if not (arrived and self.seen.stands) or self._jog:
                moved = self.now
            if self.now - moved > self.motion.settle:
                break
            yield
        yield from self._switching_off()

    def _stopping(self) -> Iterator[None]:
        # A motion that was asked for may still begin.
        within = _REPORTED_WITHIN_S if self.movements.waits else _RECEIVED_S
        self.movements.forget()
        # Without samples it cannot be seen that the stage stands.
        while self.seen.fresh and (self._jog or not (self._overdue(within) and self.seen.at_rest)):
            if self._due():
                self.machine.request("driver/end_motion")
            yield
        # Also if it seems off: without samples it may be on, or a request to switch it on may still wait.
        self.machine.request("driver/enable", False)
        yield from self._switching_off()

    def _aborting(self) -> Iterator[None]:
        # Unless it was stopping, the stage keeps its trajectory and comes to rest at the end of its movement.
        self.movements.forget()
        for _ in self._switching_off():
            if self._overdue(_OFF_WITHIN_S):
                return
            yield

    def _clearing(self, least: float = _REPORTED_WITHIN_S) -> Iterator[None]:
        yield from self._asking(
            partial(self.machine.request, "driver/reset_fault"),
            lambda: not self.seen.faults and self._overdue(least),
            lambda: f"the fault remains: {self.seen.fault}",
        )

    def _switching_on(self) -> Iterator[None]:
        answers = [""]
        yield from self._asking(
            lambda: self.machine.request("driver/enable", True, answers.append),
            lambda: self.seen.amplifier_on,
            lambda: f"the driver refuses to enable: {answers[-1] or 'no answer'}",
        )

    def _switching_off(self) -> Iterator[None]:
        while self.seen.amplifier_on:
            if self._due():
                self.machine.request("driver/enable", False)
            yield

    def _asking(self, ask: Callable[[], None], done: Callable[[], bool], why: Callable[[], str]) -> Iterator[None]:
        """Repeat a request until it is done; fails after the start timeout with the text of ``why``."""
        end, self._asked = self.now + self.start_timeout, -math.inf
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
