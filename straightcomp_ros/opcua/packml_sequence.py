"""The machine's state, advanced by commands from outside and by what is seen of the graph."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.model.stage import MotionParameters, Waypoint
from straightcomp_ros.opcua.motion import movement
from straightcomp_ros.opcua.orders import Order, order_refusal
from straightcomp_ros.opcua.packml import ACCEPTED, DONE, FAILED, Command, State, name, refusal

_ASK_AGAIN_S = 0.5
_SETTLE_S = 1.5
"""A node that has just come up allocates and connects for about a second more, and loses messages meanwhile."""
_OFF_WITHIN_S = 2.0
"""A driver that has not switched off by then is dead or deaf; its machine's own watchdog has switched off."""
_REPORTED_WITHIN_S = 1.5
"""A fault that is there, or one that is gone, shows in the diagnostics by then."""
_ARRIVE_WITHIN_S = 5.0
_ARRIVED_M = 10e-6
MOST_STROKES = 1_000_000
Answer = Callable[[str], None]
"""Takes why something was refused, or an empty text."""


class Machine(Protocol):
    """What the sequence asks of the graph. Nothing here waits; answers show in the next observations."""

    refusal: str  # why the last switch_on was refused; empty while it is not answered, and when it was done

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


class CellSequence:
    """State machine of the cell.

    Args:
        machine: what acts.
        motion: of each stroke.
        start_timeout: longest Resetting, Starting or Clearing, s.
        clock: monotonic time, s.

    Attributes:
        state: present state.
        message: why the state is what it is, or why the last command was refused.
        strokes: that the last Start asked for, each forward and back; 0 compensates until Complete or Stop.
        strokes_done: of these.
        centred: the reference is in the middle of the travel, or has been asked to go there.
    """

    def __init__(
        self,
        machine: Machine,
        motion: MotionParameters,
        start_timeout: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._machine, self._motion, self._start_timeout, self._clock = machine, motion, start_timeout, clock
        self.state = State.STOPPED
        self.message = ""
        self.strokes = self.strokes_done = 0
        self.centred = False
        self._now = self._since = self._unready = clock()
        self._asked = -math.inf
        self._movement = 0
        self._moving_until_ns: int | None = None
        self._goal = 0.0
        self._moved = 0.0
        self._works: Mapping[State, Callable[[Observation], bool]] = {
            State.RESETTING: self._resetting,
            State.STARTING: self._starting,
            State.EXECUTE: self._execute,
            State.HOLDING: self._holding,
            State.UNHOLDING: lambda seen: True,
            State.COMPLETING: self._completing,
            State.STOPPING: self._stopping,
            State.ABORTING: self._aborting,
            State.CLEARING: self._clearing,
        }

    @property
    def at_work(self) -> bool:
        """The amplifier is, or is about to be, on because of this."""
        return self.state in ACCEPTED[Command.STOP] or self.state is State.STOPPING

    def command(self, command: Command, strokes: int = 0) -> str:
        """Take a command.

        Args:
            command: what is asked.
            strokes: for Start.

        Returns:
            Why it is refused; empty where it is accepted.
        """
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
            self.strokes, self.strokes_done, self._movement = strokes, 0, 0
        self._enter(ACCEPTED[command][self.state], f"command {name(command)}")
        return ""

    def order(self, order: Order, middle: bool, then: Answer) -> None:
        """Ask for another reference.

        Args:
            order: what is asked.
            middle: for Center: to the middle of the travel; false: back to the map.
            then: gets why it is refused, or an empty text, now or when the node has answered.
        """
        reason = order_refusal(order, self.state)
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
        self._now = self._clock()
        # In Stopped the graph may be somebody else's: its faults show as alarms, and are none of ours.
        if self.state not in (State.STOPPED, State.ABORTING, State.ABORTED, State.CLEARING):
            trouble = self._trouble(seen)
            if trouble:
                self._enter(State.ABORTING, trouble)
        work = self._works.get(self.state)
        if work is not None and work(seen):
            self._enter(DONE[self.state], self.message)

    def _enter(self, state: State, message: str) -> None:
        self.state, self.message = state, message
        self._since = self._unready = self._clock()
        self._asked = -math.inf
        if state is State.ABORTING:
            self._machine.switch_off()

    def _fail(self, message: str) -> bool:
        self._enter(FAILED[self.state], message)
        return False

    def _trouble(self, seen: Observation) -> str:
        if seen.fault:
            return seen.fault
        if self.state in (State.RESETTING, State.STOPPING, State.COMPLETE):
            return ""
        if seen.missing:
            return f"nodes that do not work: {', '.join(seen.missing)}"
        if not seen.fresh:
            return "no samples come in"
        on = (State.EXECUTE, State.HOLDING, State.HELD, State.UNHOLDING)
        return "the amplifier went off" if self.state in on and not seen.amplifier_on else ""

    def _due(self) -> bool:
        """Whether to ask (again) now."""
        if self._now - self._asked < _ASK_AGAIN_S:
            return False
        self._asked = self._now
        return True

    def _overdue(self, seconds: float) -> bool:
        return self._now - self._since > seconds

    def _resetting(self, seen: Observation) -> bool:
        if seen.obstacle:
            self._unready = self._now
            if seen.missing and self._due():
                self._machine.activate()
            return self._fail(f"not ready: {seen.obstacle}") if self._overdue(self._start_timeout) else False
        if self._due():
            # Wherever it was left, by whomever. Refused while it is on its way: then again.
            self._machine.center(False, self._back_on_the_map)
        return self._now - self._unready >= _SETTLE_S

    def _back_on_the_map(self, refusal: str) -> None:
        self.centred = self.centred and bool(refusal)

    def _starting(self, seen: Observation) -> bool:
        if seen.amplifier_on:
            return True
        if self._overdue(self._start_timeout):
            return self._fail(f"the driver refuses to enable: {self._machine.refusal or 'no answer'}")
        if self._due():
            self._machine.switch_on()
        return False

    def _execute(self, seen: Observation) -> bool:
        if self.strokes == 0:
            return False
        if not self._arrived(seen):
            return False
        if self.strokes_done >= self.strokes:
            return True
        self._start_movement(seen)
        return False

    def _start_movement(self, seen: Observation) -> None:
        waypoints = movement(self._motion, seen.x, self._movement)
        self._goal = waypoints[-1].position
        self._moving_until_ns = seen.stamp_ns + waypoints[-1].time_ns
        self._moved = self._now + waypoints[-1].time_ns * 1e-9
        self._machine.move(waypoints)

    def _arrived(self, seen: Observation) -> bool:
        """Whether no movement of ours is under way; counts one that has just ended."""
        if self._moving_until_ns is None:
            return True
        over = seen.stamp_ns >= self._moving_until_ns and seen.still
        if over and abs(seen.x - self._goal) < _ARRIVED_M:
            self._moving_until_ns = None
            self._movement += 1
            self.strokes_done = self._movement // 2
            return True
        if self._now > self._moved + _ARRIVE_WITHIN_S and seen.still:
            self._moving_until_ns = None
            return self._fail(f"the stage did not arrive at {self._goal:.6f} m; it stands at {seen.x:.6f} m")
        return False

    def _holding(self, seen: Observation) -> bool:
        return self._arrived(seen) and seen.still

    def _completing(self, seen: Observation) -> bool:
        # The stage's last movement is over; a stage that others move may still be on its way.
        if not (self._arrived(seen) and seen.still) or not self._overdue(self._motion.settle):
            return False
        return self._switched_off(seen)

    def _stopping(self, seen: Observation) -> bool:
        # Where no samples come in, nothing tells of the movement any more.
        return (not seen.fresh or self._arrived(seen)) and self._switched_off(seen)

    def _switched_off(self, seen: Observation) -> bool:
        if not seen.amplifier_on:
            return True
        if self._due():
            self._machine.switch_off()
        return False

    def _aborting(self, seen: Observation) -> bool:
        # What the stage was told stays told: it comes to rest where its movement ends.
        self._moving_until_ns = None
        return self._switched_off(seen) or self._overdue(_OFF_WITHIN_S)

    def _clearing(self, seen: Observation) -> bool:
        if not seen.faults and self._overdue(_REPORTED_WITHIN_S):
            return True
        if self._overdue(self._start_timeout):
            return self._fail(f"the fault remains: {seen.fault}")
        if self._due():
            self._machine.reset_faults()
        return False
