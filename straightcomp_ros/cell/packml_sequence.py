"""The sequencer of the stage's cycle: PackML's state machine, for the cell node and the OPC UA gateway."""

import time
from collections.abc import Callable

from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import ACCEPTED, DONE, FAILED, Command, Order, State, name, refusal
from straightcomp_ros.cell.stage_movements import NotArrived, StageMovements
from straightcomp_ros.cell.state_work import Answer, Machine, StateWork, WorkFailed
from straightcomp_ros.model.motion import MotionParameters

MOST_STROKES = 1_000_000
AMPLIFIER_OFF = "the amplifier went off"
_BEGINNING = (Command.RESET, Command.START)
_WITHOUT_AMPLIFIER = (State.STOPPED, State.ABORTING, State.ABORTED, State.CLEARING)
_WITH_AMPLIFIER = (State.EXECUTE, State.HOLDING, State.HELD, State.UNHOLDING)
_AT_WORK = (State.STARTING, *_WITH_AMPLIFIER, State.COMPLETING, State.STOPPING, State.ABORTING)


class CellSequence:
    """State machine of the cell.

    Args:
        machine: carries out the requests.
        motion: of each stroke.
        start_timeout: longest time in Resetting, Starting, Clearing, or a step of a recovery, s.
        clock: monotonic time, s.
        as_one: all strokes are one trajectory; see :class:`StageMovements`.
        home: before the first stroke, move the platform to the middle of its travel, then back to the map.
        recoveries: how often to switch the amplifier on again after it went off in Execute.

    Attributes:
        state: current state.
        message: reason for the state, or for the refusal of the last command.
        recovered: number of times that the amplifier was switched on again.
    """

    work_of_states: type[StateWork] = StateWork

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
        self._machine, self._clock, self._recoveries = machine, clock, recoveries
        self._works = self.work_of_states(machine, motion, start_timeout, clock(), as_one=as_one, home=home)
        self.recovered, self._named = 0, False
        self._enter(State.STOPPED, "")

    @property
    def movements(self) -> StageMovements:
        """Of the stage since the last Start; with 0 strokes, Execute compensates until Complete or Stop."""
        return self._works.movements

    @property
    def centred(self) -> bool:
        """Whether the reference is in the middle of the travel, or was requested to go there."""
        return self._works.centred

    @property
    def at_work(self) -> bool:
        """Whether the sequence may have the amplifier on."""
        return self.state in _AT_WORK

    @property
    def progress(self) -> float:
        """Elapsed fraction of the current movement's time; 0 without a movement."""
        return self.movements.progress(self._works.seen)

    def command(self, command: Command, strokes: int = 0) -> str:
        """Execute a command, with the number of ``strokes`` for Start; returns the reason for a refusal, or ``""``."""
        reason = refusal(command, self.state)
        if not reason and command in _BEGINNING:
            reason = self._works.seen.occupied
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
        self._enter(ACCEPTED[command][self.state], f"command {name(command)}")
        return ""

    def order(self, order: Order, middle: bool, then: Answer) -> None:
        """Request another reference: with Center that of the ``middle`` of the travel (True) or of the map (False).

        ``then`` is called with the reason for a refusal, or an empty text, now or when the node has answered.
        """
        reason = refusal(order, self.state)
        if not reason and order is Order.CENTER and middle and self.state is State.EXECUTE and self.movements.strokes:
            reason = "Center(true) is not accepted while strokes are run; accepted after Hold, or with 0 strokes"
        if reason:
            self.message = reason
            then(reason)
            return
        state, before = self.state, self.centred

        def answered(refusal: str) -> None:
            if order is Order.CENTER:
                self._works.centred = before if refusal else middle
            if self.state is state:
                self.message = refusal or f"command {order.value}"
            then(refusal)

        if order is Order.RELOAD_MAP:
            self._machine.reload_map(answered)
        else:
            # No stroke may begin before the answer.
            self._works.centred = before or middle
            self._machine.center(middle, answered)

    def tick(self, seen: Observation) -> None:
        """Continue with the graph as ``seen`` now."""
        self._works.now, self._works.seen = self._clock(), seen
        missing = seen.absence if seen.missing else ""
        # A machine whose controller has died cannot be switched on again.
        trouble = missing if self._recovering else self._trouble(seen)
        if missing and self.state in (State.ABORTING, State.ABORTED) and not self._named:
            # A fault is seen at once, but that a node has died, which may be its cause, only from its silence.
            self._named = True
            self.message = self.message if missing in self.message else f"{self.message}; {missing}"
        if trouble and self._recoverable(seen):
            self.recovered += 1
            self._recovering, self._work = True, self._works.recover(self._work, self._has_recovered)
        elif trouble:
            self._enter(State.ABORTING, trouble)
        try:
            next(self._work)
        except StopIteration:
            if self.state in DONE:
                self._enter(DONE[self.state], self.message)
        except (WorkFailed, NotArrived) as failure:
            self._enter(FAILED[self.state], str(failure))

    def _enter(self, state: State, message: str) -> None:
        self.state, self.message = state, message
        self._recovering = False
        self._named = state is State.ABORTED and self._named
        self._work = self._works.of(state, self._clock())
        if state is State.ABORTING:
            self._machine.switch_off()

    def _has_recovered(self) -> None:
        self._recovering = False

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

    def _recoverable(self, seen: Observation) -> bool:
        """Whether the trouble is that the amplifier is off, and it may be switched on again."""
        allowed = self.state is State.EXECUTE and self.recovered < self._recoveries
        return allowed and not seen.absence and not seen.amplifier_on
