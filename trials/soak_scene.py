"""The stand in a soak run: observes the stage's motion and the logger's work, and restores normal operation."""

import math
import random
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.time import Time

from straightcomp_ros.cell.launcher import LaunchError
from straightcomp_ros.contract import DIAGNOSTICS, POSITION
from straightcomp_ros.runtime.streams import subscribe
from straightcomp_ros.safety.faults import HELD_UP, Fault
from straightcomp_ros.timing.node_timing import SAMPLES
from trials.soak_strokes import Commanded
from trials.soak_verdict import Soak
from trials.stalls import Stalls
from trials.stand import ACCELERATION, MOTION, MOTION_STROKES, STROKE_S, Stand

_STALL_MS, _STALL_S = 80.0, 1.0
"""Total duration of stalls, in the time before a fault, that may have caused it."""
_REACTION_S = 3.0
"""Longest time until a fault is latched. The fault trials measure how soon; this run checks whether."""
_REQUESTS = 2
_BACK_S = 15.0
_LEFT, _BEGUN = 50e-6, 2e-3
"""Distance in m from a motion's start within which its beginning is detected."""
_ASTRAY = 5e-3
"""Distance in m from the stage's commanded position that ends a motion: the machine was replaced."""
_WHOLE = 0.9
"""Fraction of the samples that a logger must receive from report to report to count as connected."""


class _Report(NamedTuple):
    time_ns: int
    samples: int
    written: int


class Scene:
    """Everything that actions act on.

    Args:
        stand: with the graph started.
        rng: makes the random choices.
        rate: samples per second.
        result: gets faults and times.
        stalls: tells whether this computer stalled.
        log: file that lists the actions with their times.
        maps: map files between which the feedforward may change.

    Attributes:
        killable: nodes that may be killed now.
    """

    def __init__(
        self,
        stand: Stand,
        rng: random.Random,
        rate: int,
        result: Soak,
        stalls: Stalls,
        log: Path,
        maps: tuple[str, ...],
    ) -> None:
        self.stand, self.rng, self.result, self.maps = stand, rng, result, maps
        self._stalls, self._log = stalls, log
        self.killable: tuple[str, ...] = ()
        self.commanded = Commanded(round(STROKE_S * 1e9), MOTION_STROKES)
        self._rate = rate
        self._before: tuple[int, float] = (0, 0.0)
        self._ended_ns = self._began_ns = self._interrupted_ns = 0
        self._report: _Report | None = None
        subscribe(stand.node, POSITION, self._on_position)
        stand.node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, 100)

    def note(self, words: str) -> None:
        """Log an action."""
        with self._log.open("a") as log:
            log.write(f"{time.time():.3f} {words}\n")

    def end_motion(self) -> None:
        """Note that the machine, and with it the motion, ends now."""
        self._ended_ns = time.time_ns()
        self.commanded.end(self._ended_ns)

    def interrupt(self, before_s: float = 0.0) -> None:
        """Note that from now on, or since a little before, the recording is not known to be complete."""
        self._interrupted_ns, self._report = time.time_ns(), None
        self.commanded.interrupt(self._interrupted_ns - round(before_s * 1e9))

    def ask(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service, a second time if no answer comes: a node that has just started may lose the request.

        Raises:
            LaunchError: no answer came.
        """
        for _ in range(_REQUESTS):
            answer = self.stand.call(kind, service, request)
            if answer is not None:
                return answer
            self.result.answers_lost += 1
        raise LaunchError(f"service '{service}' does not answer")

    def must_latch(self, allowed: Sequence[Fault], failures: list[str]) -> None:
        """Check that one of these faults is latched and keeps the amplifier off."""
        stand = self.stand
        if not stand.until(lambda: stand.fault is not None and stand.condition == "fault", _REACTION_S):
            failures.append(f"no fault within {_REACTION_S:g} s, the amplifier is '{stand.condition}'")
            return
        self._count(allowed, failures)
        if stand.enable():
            failures.append("the fault was not latched: the amplifier could be switched on")

    def may_latch(self, allowed: Sequence[Fault], failures: list[str]) -> None:
        """Check that the amplifier is on, or off with one of these faults."""
        if self.stand.condition == "fault" and self.stand.fault is not None:
            self._count(allowed, failures)
        elif self.stand.condition != "on":
            failures.append(f"the amplifier is '{self.stand.condition}' and no fault is latched")

    def must_be_on(self, failures: list[str]) -> None:
        """Check that the amplifier is on."""
        self.may_latch((), failures)

    def back_to_work(self) -> None:
        """Restore normal operation after any action: amplifier on, stage moving, everything recorded.

        Raises:
            LaunchError: the graph does not reach that state; the message says what is missing.
        """
        begin = time.monotonic()
        stand = self.stand
        if self.commanded.over(time.time_ns()):
            self.end_motion()
        stand.switch_on()
        if not self.commanded.moving:
            # The trajectory may have been published before the driver was connected.
            self._until(lambda: self.commanded.moving > 0, "the stage does not move", then=stand.move)
        self._until(lambda: self.commanded.recording > 0, "the logger does not record every stream", then=lambda: None)
        self.result.back_s.append(time.monotonic() - begin)

    def _until(self, condition: Callable[[], bool], refusal: str, then: Callable[[], None]) -> None:
        deadline = time.monotonic() + _BACK_S
        while not self.stand.until(condition, 1.5):
            if time.monotonic() > deadline:
                raise LaunchError(f"{refusal} {_BACK_S:g} s after the amplifier was switched on")
            then()

    def _count(self, allowed: Sequence[Fault], failures: list[str]) -> None:
        assert self.stand.fault is not None
        fault, at_ns = self.stand.fault
        stall_ms = self._stalls.total_ms(at_ns - round(_STALL_S * 1e9), at_ns)
        if fault in allowed:
            self.result.faults[fault.label] += 1
        elif fault in HELD_UP and stall_ms >= _STALL_MS:
            self.result.stalls[fault.label] += 1
        else:
            others = f"allowed: {', '.join(one.label for one in allowed)}" if allowed else "none may"
            failures.append(
                f"fault '{fault.label}' was latched; {others} (the machine stood still for {stall_ms:.0f} ms)"
            )

    def _on_position(self, stamp_ns: int, numbers: Any) -> None:
        (before_ns, x_before), x = self._before, numbers[0]
        if stamp_ns <= max(before_ns, self._ended_ns):
            return
        self._before = stamp_ns, x
        if self.commanded.moving:
            if abs(x - MOTION.position(stamp_ns - self._began_ns)) > _ASTRAY:
                self._ended_ns = before_ns
                self.commanded.end(before_ns)
        elif x_before < x and _LEFT <= x <= _BEGUN:
            self._began_ns = stamp_ns - round(math.sqrt(2.0 * x / ACCELERATION) * 1e9)
            self.commanded.moving = self._began_ns

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name != "logger":
                continue
            values = {value.key: value.value for value in status.values}
            time_ns = Time.from_msg(message.header.stamp).nanoseconds
            if time_ns <= self._interrupted_ns or values["recording"] != "True":
                continue
            report = _Report(time_ns, int(values[SAMPLES]), int(values["written"]))
            before, self._report = self._report, report
            if before is not None and not self.commanded.recording and self._is_whole(before, report):
                self.commanded.recording = before.time_ns

    def _is_whole(self, before: _Report, report: _Report) -> bool:
        samples = report.samples - before.samples
        expected = self._rate * (report.time_ns - before.time_ns) * 1e-9
        return samples >= _WHOLE * expected and report.written - before.written >= samples
