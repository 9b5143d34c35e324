"""The actions of a soak run on the running graph, and their checks: what is not as it must be goes into the stand's
failures.

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
from rclpy.parameter import parameter_value_to_python
from rclpy.time import Time
from std_srvs.srv import SetBool, Trigger

from straightcomp_ros.cell.launcher import COMPOSED, LaunchError
from straightcomp_ros.contract import DIAGNOSTICS, POSITION
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.runtime.streams import subscribe
from straightcomp_ros.safety.faults import HELD_UP, Fault
from straightcomp_ros.timing.node_timing import SAMPLES
from trials.faults import driver_missed, loop_missed
from trials.soak_verdict import Soak
from trials.stalls import Stalls
from trials.stand import Stand, request_of

_STALL_MS, _STALL_S = 80.0, 1.0
"""Total duration of stalls, in the time before a fault, that may have caused it."""
_REACTION_S = 3.0
"""Longest time until a fault is latched. The fault trials measure how soon; this run checks whether."""
_REQUESTS = 2
_BACK_S = 15.0
_MOVED, _RESTS_S = 50e-6, 0.5
"""m by which the stage moves within this time, unless it stands."""
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
        stalls: says whether this computer stalled.
        log: file that lists the actions with their times.
        maps: map files between which the feedforward may change.

    Attributes:
        killable: processes that may be killed now.
        recorded: times (begin, end) during which the recording was known to be complete, ns since the epoch: the
            driver was active, the logger's reports said that it recorded, and neither was stopped, paused, killed,
            deactivated or restarted.
        about: which node an action is about, for its failures.
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
        self.about = ""
        self.recorded: list[tuple[int, int]] = []
        self._rate = rate
        self._x, self._moved_s = 0.0, -math.inf
        self._interrupted_ns = self._recording_ns = 0
        self._report: _Report | None = None
        subscribe(stand.node, POSITION, self._on_position)
        stand.node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, 100)

    def note(self, words: str) -> None:
        """Log an action."""
        with self._log.open("a") as log:
            log.write(f"{time.time():.3f} {words}\n")

    @property
    def moving(self) -> bool:
        """Whether the stage moves."""
        return time.monotonic() - self._moved_s < _RESTS_S

    def interrupt(self, before_s: float = 0.0) -> None:
        """Note that from now on, or since a little before, the recording is not known to be complete."""
        self._interrupted_ns, self._report = time.time_ns(), None
        end_ns = self._interrupted_ns - round(before_s * 1e9)
        if 0 < self._recording_ns < end_ns:
            self.recorded.append((self._recording_ns, end_ns))
        self._recording_ns = 0

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

    def fail(self, words: str) -> None:
        """Note what is not as it must be."""
        self.stand.failures.append(self.about + words)

    def must_latch(self, allowed: Sequence[Fault]) -> None:
        """Check that one of these faults is latched and keeps the amplifier off."""
        stand = self.stand
        if stand.until(lambda: stand.fault is not None and stand.condition == "fault", _REACTION_S):
            self._count(allowed)
            stand.must_not_switch_on()
        else:
            self.fail(f"no fault within {_REACTION_S:g} s, the amplifier is '{stand.condition}'")

    def may_latch(self, *allowed: Fault) -> None:
        """Check that the amplifier is on, or off with one of these faults."""
        if self.stand.condition == "fault" and self.stand.fault is not None:
            self._count(allowed)
        elif self.stand.condition != "on":
            self.fail(f"the amplifier is '{self.stand.condition}' and no fault is latched")

    def back_to_work(self) -> None:
        """Restore normal operation after any action: amplifier on, stage moving, everything recorded.

        Raises:
            LaunchError: the graph does not reach that state; the message says what is missing.
        """
        begin = time.monotonic()
        stand = self.stand
        stand.switch_on()
        # The trajectory may have been published before the driver was connected.
        self._until(lambda: self.moving, "the stage does not move", then=stand.move)
        self._until(lambda: self._recording_ns > 0, "the logger does not record every stream")
        self.result.back_s.append(time.monotonic() - begin)

    def _until(self, condition: Callable[[], bool], refusal: str, then: Callable[[], None] = lambda: None) -> None:
        deadline = time.monotonic() + _BACK_S
        while not self.stand.until(condition, 1.5):
            if time.monotonic() > deadline:
                raise LaunchError(f"{refusal} {_BACK_S:g} s after the amplifier was switched on")
            then()

    def _count(self, allowed: Sequence[Fault]) -> None:
        assert self.stand.fault is not None
        fault, at_ns = self.stand.fault
        stall_ms = self._stalls.total_ms(at_ns - round(_STALL_S * 1e9), at_ns)
        if fault in allowed:
            self.result.faults[fault.label] += 1
        elif fault in HELD_UP and stall_ms >= _STALL_MS:
            self.result.faults_in_stalls[fault.label] += 1
        else:
            others = f"allowed: {', '.join(one.label for one in allowed)}" if allowed else "none may"
            self.fail(f"fault '{fault.label}' was latched; {others} (the machine stood still for {stall_ms:.0f} ms)")

    def _on_position(self, _: int, numbers: Sequence[float]) -> None:
        if abs(numbers[0] - self._x) > _MOVED:
            self._x, self._moved_s = numbers[0], time.monotonic()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            time_ns = Time.from_msg(message.header.stamp).nanoseconds
            if status.name != "logger" or time_ns <= self._interrupted_ns or values["recording"] != "True":
                continue
            report = _Report(time_ns, int(values[SAMPLES]), int(values["written"]))
            before, self._report = self._report, report
            if before is not None and not self._recording_ns:
                samples = report.samples - before.samples
                expected = self._rate * (report.time_ns - before.time_ns) * 1e-9
                if samples >= _WHOLE * expected and report.written - before.written >= samples:
                    self._recording_ns = before.time_ns


ENABLE_LIMIT_S = 2.0
"""Longest time from a request for the amplifier to 'on', with no fault latched and fresh commands."""
_PATIENCE_S = 10.0
_TAKEN_BY_A_KILL_S = 0.5
"""Longest part of a recording that SIGKILL may lose."""
_FADE_S = 0.7
"""The feedforward refuses a change of its map during the previous one, which takes 0.5 s."""


def amplifier_off_and_on(scene: Scene) -> None:
    """Amplifier off at once and without a fault; on again within :data:`ENABLE_LIMIT_S`."""
    stand = scene.stand
    scene.ask(SetBool, "driver/enable", SetBool.Request(data=False))
    if not stand.until(lambda: stand.condition == "off", 1.0):
        if stand.condition == "fault":
            # A fault was latched before the request arrived; no action caused it.
            scene.may_latch()
            return
        scene.fail(f"the amplifier is '{stand.condition}' after it was switched off")
    stand.spin(scene.rng.uniform(0.0, 0.5))
    begin = time.monotonic()
    answer = scene.ask(SetBool, "driver/enable", SetBool.Request(data=True))
    on = stand.until(lambda: stand.condition == "on", ENABLE_LIMIT_S)
    seconds = time.monotonic() - begin
    if on and seconds <= ENABLE_LIMIT_S:
        scene.result.enable_s.append(seconds)
    else:
        words = answer.message or f"fault {stand.fault}"
        scene.fail(f"'{stand.condition}' {seconds:.2f} s after enable; allowed: on within 2 s ({words})")


def reload_map(scene: Scene) -> None:
    """Read the map's file again; the amplifier must stay on."""
    scene.stand.spin(_FADE_S)
    answer = scene.ask(Trigger, "feedforward/reload_map", Trigger.Request())
    if not answer.success:
        scene.fail(f"refused: {answer.message}")
    scene.stand.spin(_FADE_S)
    scene.may_latch()


def another_map(scene: Scene) -> None:
    """Change the feedforward to another map file; the amplifier must stay on."""
    scene.stand.spin(_FADE_S)
    _change(scene, "feedforward", {"stage.guide.file": scene.rng.choice(scene.maps)})


def another_law(scene: Scene) -> None:
    """Change the controller to another law and gains, all of which hold the platform; the amplifier must stay on."""
    between = scene.rng.uniform
    gains = {
        "control.smc_observer.surface": between(450.0, 600.0),
        "control.smc_observer.bandwidth": between(380.0, 460.0),
        "control.smc.natural_frequency": between(32.0, 38.0),
    }
    _change(scene, "controller", {"control.law": scene.rng.choice(LAWS), **gains})


def refused_parameters(scene: Scene) -> None:
    """Set parameters with one wrong value: the request must be refused as a whole, with all values unchanged."""
    node, values = scene.rng.choice(_REFUSED)
    before = _values(scene, node, values)
    result = _set(scene, node, values)
    if result.successful:
        scene.fail(f"{node} took {values}")
    elif not result.reason:
        scene.fail(f"{node} refused {values} without a reason")
    after = _values(scene, node, values)
    if after != before:
        scene.fail(f"{node} refused {values}, and has {after} in place of {before}")
    scene.may_latch()


def recorded_in_parts(end: str, begin: str, between_s: tuple[float, float], scene: Scene) -> None:
    """End the recording by one service of the recorder, and begin it again by another."""
    scene.interrupt()
    _recorder(scene, end)
    scene.stand.spin(scene.rng.uniform(*between_s))
    _recorder(scene, begin)
    scene.may_latch()


def split(scene: Scene) -> None:
    """Continue the bag in a new file. Nothing is lost, so the recording does not count as interrupted."""
    _recorder(scene, "split")
    scene.may_latch()


def kill(scene: Scene) -> None:
    """Kill a node with SIGKILL and start it again. Without the logger the loop must keep running."""
    name = _signal(scene, scene.killable, signal.SIGKILL, _TAKEN_BY_A_KILL_S)
    if name == "logger":
        scene.stand.spin(1.0)
        scene.may_latch()
    else:
        _must_react(scene, name)
    scene.stand.restart(name)


def stop_for_long(scene: Scene) -> None:
    """SIGSTOP for longer than the timeouts: a fault must be latched. Without the logger the loop must keep running."""
    name = _signal(scene, scene.stand.names, signal.SIGSTOP)
    if name == "logger":
        scene.stand.spin(scene.rng.uniform(0.3, 0.7))
    else:
        _must_react(scene, name)
    scene.stand.signal(name, signal.SIGCONT)
    if name == "logger":
        scene.may_latch()
    elif name in ("driver", COMPOSED):
        # By its own clock the driver has missed commands for even longer than the controller has missed samples.
        scene.must_latch(HELD_UP)


def stop_for_short(scene: Scene) -> None:
    """SIGSTOP for less than the timeouts: on a busy computer a fault may be latched all the same."""
    name = _signal(scene, scene.stand.names, signal.SIGSTOP)
    scene.stand.spin(scene.rng.uniform(0.01, 0.1))
    scene.stand.signal(name, signal.SIGCONT)
    scene.stand.spin(0.3)
    scene.may_latch(*(() if name == "logger" else HELD_UP))


def down_and_up(scene: Scene) -> None:
    """Amplifier off, all nodes inactive in the order of the signals, and back: no fault, all active again."""
    stand = scene.stand
    scene.interrupt()
    scene.ask(SetBool, "driver/enable", SetBool.Request(data=False))
    for transition, state, names in (
        (Transition.TRANSITION_DEACTIVATE, "inactive", _ORDER[::-1]),
        (Transition.TRANSITION_ACTIVATE, "active", _ORDER),
    ):
        for name in names:
            _change_state(scene, name, transition, state)
        stand.spin(scene.rng.uniform(0.0, 0.3))
    if stand.condition == "fault":
        # With the amplifier off nothing can cause a fault, and before that only a stall of the whole computer.
        scene.may_latch()


ACTIONS: Mapping[str, Callable[[Scene], None]] = {
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
"""All kinds of action, by name. Each finds the graph at work."""
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


def _change(scene: Scene, node: str, values: Mapping[str, Any]) -> None:
    result = _set(scene, node, values)
    if not result.successful:
        scene.fail(f"{node} refused {values}: {result.reason}")
    elif (now := _values(scene, node, values)) != values:
        scene.fail(f"{node} took {values}, and has {now}")
    scene.stand.spin(_FADE_S)
    scene.may_latch()


def _set(scene: Scene, node: str, values: Mapping[str, Any]) -> Any:
    scene.note(f"  {node}: {values}")
    return scene.ask(SetParametersAtomically, f"{node}/set_parameters_atomically", request_of(values)).result


def _values(scene: Scene, node: str, names: Mapping[str, Any]) -> dict[str, Any]:
    answer = scene.ask(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=list(names)))
    return dict(zip(names, map(parameter_value_to_python, answer.values), strict=True))


def _recorder(scene: Scene, service: str) -> None:
    lost = scene.result.answers_lost
    answer = scene.ask(Trigger, f"logger/{service}", Trigger.Request())
    # A request whose answer was lost was executed all the same; the repeated request is then refused.
    if not answer.success and scene.result.answers_lost == lost:
        scene.fail(f"{service} was refused: {answer.message}")


def _must_react(scene: Scene, name: str) -> None:
    """Check what must follow when this process of the loop works no more."""
    missed = {"driver": driver_missed, COMPOSED: loop_missed}.get(name)
    if missed is None:
        scene.must_latch(HELD_UP)
    elif missed(scene.stand, Fault.SAMPLE_TIMEOUT) is None:
        scene.fail(f"it was not missed; the controller tripped with {scene.stand.tripped}")


def _signal(scene: Scene, names: Sequence[str], number: signal.Signals, lost_s: float = 0.0) -> str:
    """Send a signal to one of the processes, of whose recording the last ``lost_s`` may be lost; returns its name."""
    name = scene.rng.choice(names)
    scene.about = f"{name}: "
    scene.note(f"  {name}")
    if name in ("driver", COMPOSED, "logger"):
        scene.interrupt(lost_s)
    scene.stand.signal(name, number)
    return name


def _change_state(scene: Scene, name: str, transition: int, state: str) -> None:
    stand = scene.stand
    request = ChangeState.Request(transition=Transition(id=transition))
    # Check the node's reported state: the answer may be lost, and a repeated request is then refused.
    stand.call(ChangeState, f"{name}/change_state", request)
    if not stand.until(lambda: stand.heartbeats.states[name] == state, _PATIENCE_S):
        scene.fail(f"{name} is {stand.heartbeats.states[name]}; it must be {state}")
