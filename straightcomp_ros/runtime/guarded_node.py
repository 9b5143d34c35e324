"""A node that foreign messages and requests cannot end, and whose timers keep their periods.

Any program on the machine may publish on our topics and call our services. Without a guard the executor passes the
exception of a callback on, and the process ends with the amplifier on.

When a timer is added to an EventsExecutor (rclpy 7.1) or reset, or when the ROS clock steps, the executor queues every
timer again that is due at that moment. Such timers fire several times at once, and then stay silent until their
schedule catches up: for seconds, after a slow start. A single timer on the steady clock is never queued twice, so one
timer of the executor calls all timers of the node.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from straightcomp_ros.bags import BagError
from straightcomp_ros.hardware.interface import HardwareError
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.safety.faults import one_line
from straightcomp_ros.straightness.survey_header import SurveyError

RUN_FAILURES = (BagError, HardwareError, OSError)
"""Raised while a node runs, when a bag, the machine or a file fails: no fault of a message, so they end the node."""
REFUSALS = (*RUN_FAILURES, ParameterError, SurveyError)
"""Raised if parameters, files or the machine cannot be used."""
TICK_S = 0.02
"""Resolution of the timers."""
_TICK_NS = round(TICK_S * 1e9)
_LOG_EVERY_S = 5.0
_LONGEST_REASON = 200


class Refused(Exception):
    """A request is refused; the message is the reason."""


@dataclass(eq=False)
class SteadyTimer:
    """Calls ``callback`` every ``period_ns`` until cancelled; after a stall once, not once for each missed period."""

    period_ns: int
    callback: Callable[[], object]
    due_ns: float

    def cancel(self) -> None:
        """Never call again, and let go of what was called."""
        self.due_ns, self.callback = math.inf, lambda: None


class SteadyTimers:
    """Timers that are called in the order in which they are due, by the clock ``monotonic_ns``.

    Attributes:
        by_loop: a loop calls them, one after each of its cycles, and the executor none.
    """

    by_loop = False

    def __init__(self, monotonic_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._monotonic_ns = monotonic_ns
        self._begin_ns = monotonic_ns()
        self._timers: list[SteadyTimer] = []

    def add(self, period_s: float, callback: Callable[[], object]) -> SteadyTimer:
        """A new timer; its first call is due after ``period_s``, at a tick."""
        period_ns = round(period_s * 1e9)
        self._timers = [timer for timer in self._timers if timer.due_ns < math.inf]
        # A timer that is due between two ticks would be called at one or the other, depending on their jitter.
        ticks = -((self._begin_ns - self._monotonic_ns()) // _TICK_NS)
        self._timers.append(SteadyTimer(period_ns, callback, self._begin_ns + ticks * _TICK_NS + period_ns))
        return self._timers[-1]

    def call_one(self) -> bool:
        """Call the timer that has been due longest; returns whether one was due."""
        now_ns = self._monotonic_ns()
        timer = min(self._timers, key=lambda timer: timer.due_ns, default=None)
        if timer is None or timer.due_ns > now_ns:
            return False
        timer.due_ns += timer.period_ns
        if timer.due_ns <= now_ns:
            timer.due_ns = now_ns + timer.period_ns
        timer.callback()
        return True

    def call_all(self) -> None:
        """Call each timer that is due, once; none while a loop does."""
        for _ in [] if self.by_loop else list(self._timers):
            self.call_one()


class GuardedNode(Node):
    """Its callbacks drop a message, and refuse a request, that they cannot handle; the log says so every 5 s at most.

    :data:`RUN_FAILURES` pass. Timers are not guarded: their errors are the node's own. A loop that spins the executor
    one event at a time calls :meth:`SteadyTimers.call_one` between its cycles.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.own_timers: list[SteadyTimer] = []
        """Those of this node alone, in the order in which they were made."""
        self._steady_timers: SteadyTimers | None = None
        self._offered: dict[str, Callable[[Any, Any], Any]] = {}
        super().__init__(*arguments, **options)

    @property
    def steady_timers(self) -> SteadyTimers:
        """The timers of this node, or of all nodes in its process."""
        if self._steady_timers is None:
            self._steady_timers = SteadyTimers()
            super().create_timer(TICK_S, self._steady_timers.call_all, clock=Clock(clock_type=ClockType.STEADY_TIME))
        return self._steady_timers

    def share_timers(self, other: "GuardedNode") -> None:
        """Have timers in common with another node of this process: each timer of the executor takes its turns."""
        self._steady_timers = other.steady_timers

    def create_timer(self, period: float, callback: Callable[[], object]) -> SteadyTimer:
        """A timer on the steady clock, with a resolution of :data:`TICK_S`."""
        timer = self.steady_timers.add(period, callback)
        self.own_timers.append(timer)
        return timer

    def cancel_timers(self, first: int) -> None:
        """Cancel the node's own timers from number ``first`` on."""
        while len(self.own_timers) > first:
            self.own_timers.pop().cancel()

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[[Any], None], *more: Any, **options: Any
    ) -> Any:
        """As `rclpy.node.Node.create_subscription`."""
        dropped = ThrottledWarning(self, f"a message on '{topic}' is dropped")

        def receive(message: Any) -> None:
            try:
                callback(message)
            except RUN_FAILURES:
                raise
            except Exception as error:
                dropped.log(error)

        return super().create_subscription(kind, topic, receive, *more, **options)

    def create_service(
        self, kind: Any, name: str, callback: Callable[[Any, Any], Any], *more: Any, **options: Any
    ) -> Any:
        """As `rclpy.node.Node.create_service`."""
        refused = ThrottledWarning(self, f"a request of '{name}' is refused")

        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Refused as reason:
                return refusal(response, str(reason))
            except RUN_FAILURES:
                raise
            except Exception as error:
                return refusal(kind.Response(), refused.log(error))

        return super().create_service(kind, name, answer, *more, **options)

    def offer(self, kind: Any, name: str, act: Callable[..., str], *refusals: type[Exception]) -> None:
        """A service that answers with ``success`` and ``message``, of the kind Trigger or SetBool.

        ``act`` gets the data of a SetBool; it returns the message, or raises :class:`Refused` or one of ``refusals``.
        Once offered, the service stays as long as the node, for whatever ``act`` is offered next under its name.
        """

        def answer(request: Any, response: Any) -> Any:
            try:
                response.message = act(request.data) if hasattr(request, "data") else act()
            except refusals as error:
                raise Refused(str(error)) from error
            response.success = True
            return response

        first = name not in self._offered
        self._offered[name] = answer
        if first:
            self.create_service(kind, name, lambda request, response: self._offered[name](request, response))

    def refuse_all(self, reason: str) -> None:
        """Refuse what was offered until it is offered again.

        A client whose service ends and comes again may still see the old one and not yet the new one: its request would
        never be answered.
        """

        def refuse(request: Any, response: Any) -> Any:
            raise Refused(reason)

        self._offered.update(dict.fromkeys(self._offered, refuse))


class ThrottledWarning:
    """Warns in ``node``'s log, at most once in 5 s: a flood of messages must not fill the disk."""

    def __init__(self, node: Node, what: str) -> None:
        self._node, self._what, self._next, self._suppressed = node, what, 0.0, 0

    def log(self, error: object) -> str:
        """Log the ``error``, and how many were not logged before it; returns it in words."""
        reason = one_line(str(error) or type(error).__name__, _LONGEST_REASON)
        now = time.monotonic()
        if now < self._next:
            self._suppressed += 1
            return reason
        more = f" (and {self._suppressed} more since the last such warning)" if self._suppressed else ""
        self._node.get_logger().warning(f"{self._what}: {reason}{more}")
        self._next, self._suppressed = now + _LOG_EVERY_S, 0
        return reason


def refusal(response: Any, reason: str) -> Any:
    """``response`` as a refusal with this reason, as far as its type has room for one."""
    if hasattr(response, "success"):
        response.success = False
    for one in (response, getattr(response, "result", None)):
        for field in ("message", "reason"):
            if hasattr(one, field):
                setattr(one, field, reason)
    return response
