"""Run the graph for a long time with random actions on it, and say whether it recovered from each.

docs/safety.md has the actions, and what is checked after each of them and at the end. Exit code 0 only if nothing
failed."""

from __future__ import annotations

import argparse
import itertools
import os
import random
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from numpy.typing import NDArray
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python
from rclpy.time import Time
from std_srvs.srv import SetBool, Trigger

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.recovery import default_output, recover
from straightcomp_ros.bench.graph_bench import usage
from straightcomp_ros.cell.launcher import COMPOSED, LaunchError
from straightcomp_ros.cli.options import add_parameter_options, chosen_parameters, in_range
from straightcomp_ros.cli.output import notes, print_json, require_ros
from straightcomp_ros.contract import DIAGNOSTICS, ENCODER
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.straightness.guide_map import find_survey
from straightcomp_ros.timing.node_timing import SAMPLES
from trials import stalls
from trials.faults import trial_parameters, trials_of_processes
from trials.rig import add_output, output
from trials.stand import Stand

SUMMARY = "run the graph for a long time under random actions and check it after each"
WARM_UP_S = 10.0
"""Age from which a process is checked for growth: until then it allocates what it keeps."""
_PAUSE_S = (0.2, 2.0)
_STALL_MS, _STALL_S = 80.0, 1.0
"""Total duration of stalls, in the time before a fault, that may have caused it."""
HELD_UP = (Fault.COMMAND_TIMEOUT, Fault.SAMPLE_TIMEOUT, Fault.Y_OUT_OF_RANGE, Fault.Y_FROZEN)
"""Faults that may be latched after a stall of a node, its peers or the whole machine: without commands the platform may
reach its stop before the timeout."""
_BACK_S, _PATIENCE_S = 15.0, 10.0
_MOVED = 50e-6
"""m by which a stage has moved that moves."""
_WHOLE = 0.9
"""Fraction of the samples that a logger must receive from report to report to count as connected."""
_TAKEN_BY_A_KILL_S = 0.5
"""Longest part of a recording that SIGKILL may lose."""
_FADE_S = 0.7
"""The feedforward refuses a change of its map during the previous one, which takes 0.5 s."""
HISTORIES_MB = 60.0
"""What a process may take once: the middleware keeps, for the lease of a killed recorder, the batches that it has not
acknowledged, and does not give their memory back. Driver, feedforward and controller in one process grew by 48 to 51 MB
in the first six kills of the recorder, and by 1 MB in the next eight."""
LONGEST_GAP_S = 0.6
"""Half a stroke: a stalled computer may lose so much of a recording."""
_OF_A_THREAD = "/schedstat"
"""A node's file that counts a thread's waits for a CPU: open from the report after the thread's start until the look
after its end, so that there may be one more or less of them than threads for a while."""
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    kind, text = in_range(float, 0.0, 7 * 24 * 60.0), "duration of the actions in minutes (default: 30)"
    parser.add_argument("--minutes", type=kind, default=30.0, help=text)
    parser.add_argument("--seed", type=int, default=1, help="seed of the random choices (default: 1)")
    parser.add_argument("--composed", action="store_true", help="driver, feedforward and controller in one process")
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    require_ros()
    values, rng, begin = trial_parameters(chosen_parameters(options)), random.Random(options.seed), time.monotonic()
    stage, priority = node_parameters("feedforward", values).stage, values["driver"].get("realtime.priority", 0)
    with output(options) as folder:
        # A copy of the map: a different one might lead the platform out of its travel.
        copy = shutil.copyfile(find_survey(stage.guide.file), folder / "another_map.csv")
        with Stand(folder, values, options.composed) as stand:
            stand.graph.start_program("stalls", [sys.executable, "-m", stalls.__name__, str(priority)])
            stalled = partial(stalls.total_ms, stand.graph.log("stalls"))
            soak = Soak(stand, rng, stage.rate, stalled, (stage.guide.file, str(copy)))
            soak.run(60.0 * options.minutes)
        bags, missing = missing_in_bags(folder, soak.recorded)
    figures = {"seed": options.seed, "seconds": time.monotonic() - begin, "bags": bags, **soak.figures(missing)}
    print_json(figures)
    return int(not figures["passed"])


class Soak:
    """The stand in a soak run: it observes the logger's work, checks what must follow an action, restores normal
    operation, and counts.

    Args:
        rate: samples per second.
        stalled: says for how many ms this computer stalled from a time to another, ns since the epoch.
        maps: map files between which the feedforward may change.

    Attributes:
        killable: processes that may be killed now.
        recorded: times (begin, end) during which the recording was known to be complete, ns since the epoch: the
            driver was active, the logger's reports said that it recorded, and neither was stopped, paused, killed,
            deactivated or restarted.
        counts: how often each kind of action was done; faults latched as required or permitted, and those that the
            graph latched by itself while this computer stalled (without a stall they are failures), by name.
        back_s: times from an action to normal operation.
        looks: the first and the last at each process, by its name and id, since its warm-up, while the graph works.
    """

    def __init__(
        self, stand: Stand, rng: random.Random, rate: int, stalled: Callable[[int, int], float], maps: Sequence[str]
    ) -> None:
        self.stand, self.rng, self.maps, self._rate, self._stalled = stand, rng, maps, rate, stalled
        self.killable: Sequence[str] = ()
        self.recorded: list[tuple[int, int]] = []
        self.counts = {name: Counter[str]() for name in ("actions", "faults", "faults_in_stalls")}
        self.back_s = list[float]()
        self.looks: dict[tuple[str, int], tuple[Look, Look]] = {}
        self._interrupted_ns = self._recording_ns = 0
        self._report: tuple[int, int, int] | None = None
        stand.node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, 100)

    def run(self, seconds: float) -> None:
        """Act for so long: all kinds equally often, in random order. Then stop the nodes like an operator."""
        stand, rng = self.stand, self.rng
        self.back_to_work()
        killed = rng.sample(stand.names, len(stand.names))
        half, started = len(killed) // 2, time.monotonic()
        # Every kind once, in random order, again and again.
        for kind in (kind for _ in itertools.count() for kind in rng.sample(list(ACTIONS), len(ACTIONS))):
            passed = time.monotonic() - started
            self.killable = killed[:half] if passed < 0.5 * seconds else killed[half:]
            if passed >= seconds or not self._done(kind):
                break
        stand.about = ""
        self._look()
        self.interrupt()
        for name, code in stand.stop().items():
            if code != 0:
                stand.fail(f"{name} stopped with exit code {code}")

    def _done(self, kind: str) -> bool:
        """Do one action and restore normal operation; returns whether that was possible."""
        stand = self.stand
        stand.about = f"{kind}: "
        self.note(kind)
        self.counts["actions"][kind] += 1
        try:
            # The amplifier may be off: it was switched off, or the driver is a new one.
            self.check(ACTIONS[kind](self) or (), on=False)
            self.back_to_work()
        except (LaunchError, ProcessLookupError) as error:
            stand.fail(f"not back to work: {error}")
            return False
        self._look()
        stand.spin(self.rng.uniform(*_PAUSE_S))
        stand.about = f"{kind}: later, with nothing done: "
        self.check()
        if stand.condition != "on":
            # Restore also after a permitted fault: the next action must not find it.
            with suppress(LaunchError):
                self.back_to_work()
        return True

    def _look(self) -> None:
        # A node that has ended by itself, or does not answer, is found by the next action.
        with suppress(OSError):
            for name, pid in self.stand.processes.items():
                if time.monotonic() - self.stand.started[name] >= WARM_UP_S:
                    now = look(pid)
                    self.looks[name, pid] = self.looks.get((name, pid), (now,))[0], now

    def figures(self, failures: Sequence[str]) -> dict[str, Any]:
        """Values by name; with further ``failures``. A run has passed if at least one action was done and nothing
        failed."""
        grew = [
            words for (name, pid), looks in self.looks.items() for words in grown(f"{name} (process {pid})", *looks)
        ]
        failed = [*self.stand.failures, *failures, *grew]
        return {
            **self.counts,
            "answers_lost": self.stand.answers_lost,
            "longest_back_to_work_s": max(self.back_s, default=None),
            "recorded_s": sum(end - begin for begin, end in self.recorded) * 1e-9,
            "processes": [
                {"name": name, "first": first._asdict(), "last": last._asdict()}
                for (name, _), (first, last) in self.looks.items()
            ],
            "failures": failed,
            "passed": bool(self.counts["actions"]) and not failed,
        }

    def note(self, words: str) -> None:
        """Say what is done, and when, on standard error."""
        notes.print(f"{time.time():.3f} {words}")

    def interrupt(self, before_s: float = 0.0) -> None:
        """Note that from now on, or since a little before, the recording is not known to be complete."""
        self._interrupted_ns, self._report = time.time_ns(), None
        end_ns = self._interrupted_ns - round(before_s * 1e9)
        if 0 < self._recording_ns < end_ns:
            self.recorded.append((self._recording_ns, end_ns))
        self._recording_ns = 0

    def chosen(self, names: Sequence[str], lost_s: float = 0.0) -> str:
        """One of the processes, to be stopped or killed now, of whose recording the last ``lost_s`` may be lost."""
        name = self.rng.choice(names)
        self.stand.about += f"{name}: "
        self.note(f"  {name}")
        if name in ("driver", COMPOSED, "logger"):
            self.interrupt(lost_s)
        return name

    def check(self, allowed: Sequence[Fault] = (), on: bool = True) -> None:
        """Check that no fault is latched but one of these, and unless one is that the amplifier is ``on``."""
        stand = self.stand
        if stand.condition != "fault" or stand.fault is None:
            if on and stand.condition != "on":
                stand.fail(f"the amplifier is '{stand.condition}' and no fault is latched")
            return
        fault, at_ns = stand.fault
        stall_ms = self._stalled(at_ns - round(_STALL_S * 1e9), at_ns)
        if fault in allowed:
            self.counts["faults"][fault.label] += 1
        elif fault in HELD_UP and stall_ms >= _STALL_MS:
            self.counts["faults_in_stalls"][fault.label] += 1
        else:
            others = f"allowed: {', '.join(one.label for one in allowed)}" if allowed else "none may"
            stand.fail(f"fault '{fault.label}' was latched; {others} (the machine stood still for {stall_ms:.0f} ms)")

    def back_to_work(self) -> None:
        """Restore normal operation after any action: amplifier on, stage moving, everything recorded.

        Raises:
            LaunchError: the graph does not reach that state; the message says what is missing.
        """
        begin, stand = time.monotonic(), self.stand
        stand.switch_on()
        x = stand.x
        for condition, missing in (
            (lambda: abs(stand.x - x) > _MOVED, "the stage does not move"),
            (lambda: self._recording_ns > 0, "the logger does not record every stream"),
        ):
            deadline = time.monotonic() + _BACK_S
            while not stand.until(condition, 1.5):
                if time.monotonic() > deadline:
                    raise LaunchError(f"{missing} {_BACK_S:g} s after the amplifier was switched on")
                # The trajectory may have been published before the driver was connected.
                stand.move()
        self.back_s.append(time.monotonic() - begin)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            time_ns = Time.from_msg(message.header.stamp).nanoseconds
            if status.name != "logger" or time_ns <= self._interrupted_ns or values["recording"] != "True":
                continue
            report = time_ns, int(values[SAMPLES]), int(values["written"])
            before, self._report = self._report, report
            if before is not None and not self._recording_ns:
                passed_ns, samples, written = (new - old for new, old in zip(report, before, strict=True))
                if samples >= _WHOLE * self._rate * passed_ns * 1e-9 and written >= samples:
                    self._recording_ns = before[0]


def amplifier_off_and_on(soak: Soak) -> None:
    """Amplifier off at once and without a fault; back at work it is on again."""
    stand = soak.stand
    stand.call(SetBool, "driver/enable", data=False)
    # A fault that was latched before the request arrived is found by the check that follows.
    if not stand.until(lambda: stand.condition in ("off", "fault"), 1.0):
        stand.fail(f"the amplifier is '{stand.condition}' after it was switched off")
    stand.spin(soak.rng.uniform(0.0, 0.5))


def set_parameters(draw: Callable[[Soak], tuple[str, Mapping[str, Any]]], refused: bool, soak: Soak) -> None:
    """Set parameters of a node: others with which the platform is held; or some of which one is wrong, a request that
    must be ``refused`` as a whole, and with a reason."""
    stand, (node, values) = soak.stand, draw(soak)

    def present() -> dict[str, Any]:
        answer = stand.call(GetParameters, f"{node}/get_parameters", names=list(values))
        return dict(zip(values, map(parameter_value_to_python, answer.values), strict=True))

    stand.spin(_FADE_S)
    soak.note(f"  {node}: {values}")
    before, result, after = present(), stand.set(node, values), present()
    if result.successful is refused or (refused and not result.reason):
        stand.fail(f"{node} {'took' if result.successful else 'refused'} {values}: '{result.reason}'")
    elif after != (before if refused else values):
        stand.fail(f"{node} had {before}, was asked for {values}, and has {after}")
    stand.spin(_FADE_S)


def _law(soak: Soak) -> tuple[str, Mapping[str, Any]]:
    between = soak.rng.uniform
    return "controller", {
        "control.smc_observer.surface": between(450.0, 600.0),
        "control.smc_observer.bandwidth": between(380.0, 460.0),
        "control.smc.natural_frequency": between(32.0, 38.0),
        "control.law": soak.rng.choice(LAWS),
    }


def _map(soak: Soak) -> tuple[str, Mapping[str, Any]]:
    return "feedforward", {"stage.guide.file": soak.rng.choice(soak.maps)}


def ask_trigger(services: Sequence[str], between_s: tuple[float, float], soak: Soak) -> None:
    """Call services one after the other, none of which may refuse; two of the recorder end a recording and begin it
    again. A split of the bag alone loses nothing, so the recording does not count as interrupted."""
    if len(services) > 1:
        soak.interrupt()
    for service in services:
        lost = soak.stand.answers_lost
        answer = soak.stand.call(Trigger, service)
        # A request whose answer was lost was executed all the same; the repeated request is then refused.
        if not answer.success and soak.stand.answers_lost == lost:
            soak.stand.fail(f"{service} was refused: {answer.message}")
        soak.stand.spin(soak.rng.uniform(*between_s))


def kill_or_stop(how: str, soak: Soak) -> Sequence[Fault]:
    """SIGKILL and a new start, or SIGSTOP for longer than the timeouts: what the trials of faults ask for, or another
    fault that comes of it, as the platform may be at its stop before. Without the logger the loop must keep running."""
    stand = soak.stand
    name = soak.chosen(soak.killable, _TAKEN_BY_A_KILL_S) if how == "SIGKILL" else soak.chosen(stand.names)
    (trial,) = (one for one in trials_of_processes(COMPOSED in stand.names) if one.name == f"{name} {how}")
    trial.make(stand)
    if name == "logger":
        stand.spin(1.0)
    elif trial.judge(stand, [trial.fault, *HELD_UP]) is None:
        stand.fail(f"{trial.fault.label} was not found; '{stand.condition}', {stand.fault}, {stand.tripped}")
    trial.restore(stand)
    return () if name == "logger" else HELD_UP


def stop_for_short(soak: Soak) -> Sequence[Fault]:
    """SIGSTOP for less than the timeouts: on a busy computer a fault may be latched all the same."""
    name = soak.chosen(soak.stand.names)
    soak.stand.signal(name, signal.SIGSTOP)
    soak.stand.spin(soak.rng.uniform(0.01, 0.1))
    soak.stand.signal(name, signal.SIGCONT)
    soak.stand.spin(0.3)
    return () if name == "logger" else HELD_UP


def down_and_up(soak: Soak) -> None:
    """Amplifier off, all nodes inactive in the order of the signals, and back: no fault, all active again."""
    stand, order = soak.stand, tuple(soak.stand.heartbeats.states)
    soak.interrupt()
    stand.call(SetBool, "driver/enable", data=False)
    for transition, state, names in (
        (Transition.TRANSITION_DEACTIVATE, "inactive", order[::-1]),
        (Transition.TRANSITION_ACTIVATE, "active", order),
    ):
        for name in names:
            # Check the node's reported state: the answer may be lost, and a repeated request is then refused.
            stand.request(ChangeState, f"{name}/change_state", transition=Transition(id=transition))
            if not stand.until(lambda: stand.heartbeats.states[name] == state, _PATIENCE_S):  # noqa: B023
                stand.fail(f"{name} is {stand.heartbeats.states[name]}; it must be {state}")
        stand.spin(soak.rng.uniform(0.0, 0.3))


ACTIONS: Mapping[str, Callable[[Soak], Sequence[Fault] | None]] = {
    "amplifier off and on": amplifier_off_and_on,
    "map reloaded": partial(ask_trigger, ("feedforward/reload_map",), (_FADE_S, _FADE_S)),
    "another map": partial(set_parameters, _map, False),
    "another law": partial(set_parameters, _law, False),
    "refused parameters": partial(set_parameters, lambda soak: soak.rng.choice(_REFUSED), True),
    "pause and resume": partial(ask_trigger, ("logger/pause", "logger/resume"), (0.1, 0.5)),
    "split": partial(ask_trigger, ("logger/split",), (0.0, 0.0)),
    "another bag": partial(ask_trigger, ("logger/stop", "logger/start"), (0.0, 0.3)),
    "SIGKILL": partial(kill_or_stop, "SIGKILL"),
    "SIGSTOP, long": partial(kill_or_stop, "SIGSTOP"),
    "SIGSTOP, short": stop_for_short,
    "deactivate, activate": down_and_up,
}
"""All kinds of action, by name. Each finds the graph at work, and returns the faults that it may cause."""


class Look(NamedTuple):
    """One process at one time: open descriptors without those of :data:`_OF_A_THREAD`, threads, and resident memory in
    MB (10⁶ bytes)."""

    descriptors: int
    threads: int
    memory_mb: float


MAY_GAIN = Look(0, 0, HISTORIES_MB)
"""What a process may have more in its last look than in the first. A peak between them is no leak: a killed node and
its successor may both be known to the others for a while."""


def look(process_id: int) -> Look:
    """Look now; OSError if the process has ended."""
    folder, files = f"/proc/{process_id}/fd", []
    for one in os.listdir(folder):
        with suppress(FileNotFoundError):  # closed since
            files.append(os.readlink(f"{folder}/{one}"))
    descriptors = sum(not file.endswith(_OF_A_THREAD) for file in files)
    threads = len(os.listdir(f"/proc/{process_id}/task"))
    return Look(descriptors, threads, usage({"": process_id}).rss_mb[""])


def grown(who: str, first: Look, last: Look) -> list[str]:
    """Inadmissible growth of a process between two looks, in words."""
    each = zip(Look._fields, first, last, MAY_GAIN, strict=True)
    return [f"{who} has {end:g} {what} after {begin:g}" for what, begin, end, more in each if end > begin + more]


def missing_in_bags(folder: Path, recorded: Sequence[tuple[int, int]]) -> tuple[Counter[str], list[str]]:
    """How many of the bags of loggers in ``folder`` were finished, and recovered; and what they have not, in words, of
    the times that were known to be recorded, or why they cannot be read."""
    bags, stamps, failures = Counter[str](), [np.empty(0, np.int64)], []
    for bag in sorted(path for path in folder.glob("bag_*") if path.is_dir()):
        finished, whole = (bag / "metadata.yaml").exists(), bag
        try:
            if not finished:
                whole = default_output(bag)
                if not recover(bag, whole).saved:
                    raise BagError(f"bag {bag}: no message could be saved")
            streams = read_streams(whole, {ENCODER.topic: ENCODER.layout})
            stamps += [stream.stamp for stream in streams.values()]
            bags["finished" if finished else "recovered"] += 1
        except BagError as error:
            failures.append(str(error))
    if not recorded:
        failures.append("the recording was never known to be whole")
    for begin_ns, length_s in gaps(np.concatenate(stamps), recorded):
        failures.append(f"no bag has the {length_s:.1f} s from {begin_ns * 1e-9:.3f} s since the epoch on")
    return bags, failures


def gaps(stamps: NDArray[np.int64], recorded: Sequence[tuple[int, int]]) -> list[tuple[int, float]]:
    """Begin (ns) and length (s) of each longer time without a sample, while the recording was known to be complete."""
    found, stamps = [], np.unique(stamps)
    for begin, end in recorded:
        times = np.array([begin, *stamps[(stamps > begin) & (stamps < end)], end])
        lengths_s = np.diff(times) * 1e-9
        found += [(int(times[k]), float(lengths_s[k])) for k in np.flatnonzero(lengths_s > LONGEST_GAP_S)]
    return found
