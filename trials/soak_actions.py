"""The actions of a soak run on the running graph, and their checks: each action returns its failures in words.

A :class:`Scene` is the stand in such a run: it observes the stage's motion and the logger's work, and restores normal
operation."""

import math
import random
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.time import Time
from std_srvs.srv import SetBool, Trigger

from straightcomp_ros.cell.launcher import RECORDED, LaunchError
from straightcomp_ros.contract import DIAGNOSTICS, POSITION
from straightcomp_ros.control.laws import LAWS
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


ENABLE_LIMIT_S = 2.0
"""Longest time from a request for the amplifier to 'on', with no fault latched and fresh commands."""
_PATIENCE_S = 10.0
_TAKEN_BY_A_KILL_S = 0.5
"""Longest part of a recording that SIGKILL may lose."""
_FADE_S = 0.7
"""The feedforward refuses a change of its map during the previous one, which takes 0.5 s."""


def amplifier_off_and_on(scene: Scene) -> list[str]:
    """Amplifier off at once and without a fault; on again within :data:`ENABLE_LIMIT_S`."""
    failures: list[str] = []
    stand = scene.stand
    scene.ask(SetBool, "driver/enable", SetBool.Request(data=False))
    if not stand.until(lambda: stand.condition == "off", 1.0):
        if stand.condition == "fault":
            # A fault was latched before the request arrived; no action caused it.
            scene.may_latch((), failures)
            return failures
        failures.append(f"the amplifier is '{stand.condition}' after it was switched off")
    stand.spin(scene.rng.uniform(0.0, 0.5))
    begin = time.monotonic()
    answer = scene.ask(SetBool, "driver/enable", SetBool.Request(data=True))
    on = stand.until(lambda: stand.condition == "on", ENABLE_LIMIT_S)
    seconds = time.monotonic() - begin
    if not on or seconds > ENABLE_LIMIT_S:
        words = answer.message or f"fault {stand.fault}"
        failures.append(f"'{stand.condition}' {seconds:.2f} s after enable; allowed: on within 2 s ({words})")
    else:
        scene.result.enable_s.append(seconds)
    return failures


def reload_map(scene: Scene) -> list[str]:
    """Read the map's file again; the amplifier must stay on."""
    failures: list[str] = []
    scene.stand.spin(_FADE_S)
    answer = scene.ask(Trigger, "feedforward/reload_map", Trigger.Request())
    if not answer.success:
        failures.append(f"refused: {answer.message}")
    scene.stand.spin(_FADE_S)
    scene.must_be_on(failures)
    return failures


def another_map(scene: Scene) -> list[str]:
    """Change the feedforward to another map file; the amplifier must stay on."""
    scene.stand.spin(_FADE_S)
    return _changed(scene, "feedforward", {"stage.guide.file": scene.rng.choice(scene.maps)})


def another_law(scene: Scene) -> list[str]:
    """Change the controller to another law and gains, all of which hold the platform; the amplifier must stay on."""
    between = scene.rng.uniform
    gains = {
        "control.smc_observer.surface": between(450.0, 600.0),
        "control.smc_observer.bandwidth": between(380.0, 460.0),
        "control.smc.natural_frequency": between(32.0, 38.0),
    }
    return _changed(scene, "controller", {"control.law": scene.rng.choice(LAWS), **gains})


def refused_parameters(scene: Scene) -> list[str]:
    """Set parameters with one wrong value: the request must be refused as a whole, with all values unchanged."""
    failures: list[str] = []
    node, values = scene.rng.choice(_REFUSED)
    before = _values(scene, node, values)
    result = _set(scene, node, values)
    if result.successful:
        failures.append(f"{node} took {values}")
    elif not result.reason:
        failures.append(f"{node} refused {values} without a reason")
    after = _values(scene, node, values)
    if after != before:
        failures.append(f"{node} refused {values}, and has {after} in place of {before}")
    scene.must_be_on(failures)
    return failures


def recorded_in_parts(end: str, begin: str, between_s: tuple[float, float], scene: Scene) -> list[str]:
    """End the recording by one service of the recorder, and begin it again by another."""
    failures: list[str] = []
    scene.interrupt()
    _recorder(scene, end, failures)
    scene.stand.spin(scene.rng.uniform(*between_s))
    _recorder(scene, begin, failures)
    scene.must_be_on(failures)
    return failures


def split(scene: Scene) -> list[str]:
    """Continue the bag in a new file. Nothing is lost, so the recording does not count as interrupted."""
    failures: list[str] = []
    _recorder(scene, "split", failures)
    scene.must_be_on(failures)
    return failures


def kill(scene: Scene) -> list[str]:
    """Kill a node with SIGKILL and start it again. Without the logger the loop must keep running."""
    failures: list[str] = []
    stand, name = scene.stand, scene.rng.choice(scene.killable)
    scene.note(f"  {name}")
    if name in ("driver", "logger"):
        scene.interrupt(_TAKEN_BY_A_KILL_S)
    if name == "driver":
        scene.end_motion()
    stand.signal(name, signal.SIGKILL)
    if name == "logger":
        stand.spin(1.0)
        scene.must_be_on(failures)
    elif name == "driver":
        _must_trip(scene, failures)
        stand.condition = ""
    else:
        scene.must_latch(HELD_UP, failures)
    failures += stand.restart(name)
    if name == "driver" and (not stand.until(lambda: stand.condition != "", 30.0) or stand.condition == "on"):
        failures.append(f"the new driver's amplifier is '{stand.condition}'")
    return [f"{name}: {words}" for words in failures]


def stop_for_long(scene: Scene) -> list[str]:
    """SIGSTOP for longer than the timeouts: a fault must be latched. Without the logger the loop must keep running."""
    failures: list[str] = []
    name = scene.rng.choice(RECORDED)
    _halt(scene, name)
    if name == "logger":
        scene.stand.spin(scene.rng.uniform(0.3, 0.7))
    elif name == "driver":
        _must_trip(scene, failures)
    else:
        scene.must_latch(HELD_UP, failures)
    scene.stand.signal(name, signal.SIGCONT)
    if name == "logger":
        scene.must_be_on(failures)
    elif name == "driver":
        # By its own clock the driver has missed commands for even longer than the controller has missed samples.
        scene.must_latch(HELD_UP, failures)
    return [f"{name}: {words}" for words in failures]


def stop_for_short(scene: Scene) -> list[str]:
    """SIGSTOP for less than the timeouts: on a busy computer a fault may be latched all the same."""
    failures: list[str] = []
    name = scene.rng.choice(RECORDED)
    _halt(scene, name)
    scene.stand.spin(scene.rng.uniform(0.01, 0.1))
    scene.stand.signal(name, signal.SIGCONT)
    scene.stand.spin(0.3)
    scene.may_latch(() if name == "logger" else HELD_UP, failures)
    return [f"{name}: {words}" for words in failures]


def down_and_up(scene: Scene) -> list[str]:
    """Amplifier off, all nodes inactive in the order of the signals, and back: no fault, all active again."""
    failures: list[str] = []
    stand = scene.stand
    scene.interrupt()
    scene.ask(SetBool, "driver/enable", SetBool.Request(data=False))
    for transition, state, names in (
        (Transition.TRANSITION_DEACTIVATE, "inactive", reversed(_ORDER)),
        (Transition.TRANSITION_ACTIVATE, "active", _ORDER),
    ):
        for name in names:
            _change_state(scene, name, transition, state, failures)
        stand.spin(scene.rng.uniform(0.0, 0.3))
    if stand.condition == "fault":
        # With the amplifier off nothing can cause a fault, and before that only a stall of the whole computer.
        scene.may_latch((), failures)
    return failures


ACTIONS: Mapping[str, Callable[[Scene], list[str]]] = {
    "amplifier off and on": amplifier_off_and_on,
    "map reloaded": reload_map,
    "another map": another_map,
    "another law": another_law,
    "refused parameters": refused_parameters,
    "pause and resume": partial(recorded_in_parts, "pause", "resume", (0.1, 0.5)),
    "split": split,
    "another bag": partial(recorded_in_parts, "stop", "start", (0.0, 0.3)),
    "SIGKILL": kill,
    "SIGSTOP, long": stop_for_long,
    "SIGSTOP, short": stop_for_short,
    "deactivate, activate": down_and_up,
}
"""All kinds of action, by name. Each finds the graph at work and returns its failures."""
_ORDER = ("driver", "feedforward", "controller", "logger")
_REFUSED: tuple[tuple[str, Mapping[str, Any]], ...] = (
    ("controller", {"control.law": "linear", "control.smc_observer.surface": -1.0}),
    ("controller", {"control.smc_observer.surface": 500.0, "control.law": "no such law"}),
    ("controller", {"control.smc_observer.surface": 510.0, "stage.rate": 1000}),
    ("controller", {"control.law": "smc", "control.smc.rho": 1e-6}),
    ("feedforward", {"stage.guide.runout": 0.03, "stage.guide.file": "no_such_file.csv"}),
    ("driver", {"stage.actuator.current_limit": 0.95, "stage.rate": 1000}),
    ("logger", {"min_free_bytes": 1000, "output": "elsewhere"}),
)
"""By node, parameters of which the second is invalid."""


def _changed(scene: Scene, node: str, values: Mapping[str, Any]) -> list[str]:
    failures: list[str] = []
    result = _set(scene, node, values)
    if not result.successful:
        failures.append(f"{node} refused {dict(values)}: {result.reason}")
    elif (now := _values(scene, node, values)) != dict(values):
        failures.append(f"{node} took {dict(values)}, and has {now}")
    scene.stand.spin(_FADE_S)
    scene.must_be_on(failures)
    return failures


def _set(scene: Scene, node: str, values: Mapping[str, Any]) -> Any:
    scene.note(f"  {node}: {dict(values)}")
    parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    request = SetParametersAtomically.Request(parameters=parameters)
    return scene.ask(SetParametersAtomically, f"{node}/set_parameters_atomically", request).result


def _values(scene: Scene, node: str, names: Mapping[str, Any]) -> dict[str, Any]:
    answer = scene.ask(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=list(names)))
    return dict(zip(names, map(parameter_value_to_python, answer.values), strict=True))


def _recorder(scene: Scene, service: str, failures: list[str]) -> None:
    lost = scene.result.answers_lost
    answer = scene.ask(Trigger, f"logger/{service}", Trigger.Request())
    # A request whose answer was lost was executed all the same; the repeated request is then refused.
    if not answer.success and scene.result.answers_lost == lost:
        failures.append(f"{service} was refused: {answer.message}")


def _halt(scene: Scene, name: str) -> None:
    scene.note(f"  {name}")
    if name in ("driver", "logger"):
        scene.interrupt()
    scene.stand.signal(name, signal.SIGSTOP)


def _must_trip(scene: Scene, failures: list[str]) -> None:
    """The controller must report missing samples and request the amplifier off."""
    stand = scene.stand
    if not stand.until(lambda: stand.tripped is not None, _PATIENCE_S):
        failures.append(f"the controller has not asked for the amplifier to be switched off within {_PATIENCE_S:g} s")
    elif stand.tripped.fault is not Fault.SAMPLE_TIMEOUT:
        tripped, allowed = stand.tripped.fault.label, Fault.SAMPLE_TIMEOUT.label
        failures.append(f"the controller tripped with '{tripped}'; allowed: {allowed}")


def _change_state(scene: Scene, name: str, transition: int, state: str, failures: list[str]) -> None:
    stand = scene.stand
    request = ChangeState.Request(transition=Transition(id=transition))
    # Check the node's reported state: the answer may be lost, and a repeated request is then refused.
    stand.call(ChangeState, f"{name}/change_state", request)
    if not stand.until(lambda: stand.heartbeats.states[name] == state, _PATIENCE_S):
        failures.append(f"{name} is {stand.heartbeats.states[name]}; it must be {state}")
