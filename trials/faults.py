"""Inject every fault into the running graph, measure how soon it is latched, and tell whether that is soon enough.

Starts driver, feedforward, controller and logger on the simulated machine, and injects each fault with the stage moving
and the amplifier on. Exit code 0 if every row is green."""

from __future__ import annotations

import argparse
import itertools
import math
import signal
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from straightcomp_ros.cell.launcher import RECORDED
from straightcomp_ros.cli.options import add_parameter_options, chosen_parameters
from straightcomp_ros.cli.output import CommandFailed, print_json, require_ros
from straightcomp_ros.parameters.node_parameters import STAGE
from straightcomp_ros.safety.faults import ALLOWANCE_MS, Fault
from trials.faulty_driver import CLOCK_STEP, LATE_COMMANDS
from trials.rig import Progress, add_output, output, progress
from trials.stand import Stand

SUMMARY = "inject every fault in the running graph and measure its detection"
_REPEATS, _QUICK = 20, 3
COMMAND_TIMEOUT, SAMPLE_TIMEOUT = 0.25, 0.4
"""s, in the trials."""
_OTHERS = {
    Fault.COMMAND_TIMEOUT: COMMAND_TIMEOUT * 1e3 - 5.0,
    Fault.SAMPLE_TIMEOUT: SAMPLE_TIMEOUT * 1e3 - 1000.0,
}
"""Time that these trials' parameters add to the faults' reaction times, which are those of the defaults."""
_PATIENCE_S, _ANSWER_S, _REQUESTS = 8.0, 1.0, 8
"""A node that has just started may lose a request, or its answer."""
_AGAIN = 3
"""Repetitions of an injection during which the computer stalled, so that another fault came first."""
_DRIFT_S = 0.2


def trial_parameters(values: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Parameters by node and dotted name for the trials, from those to start from."""
    chosen = {node: dict(values.get(node, {})) for node in (STAGE, *RECORDED)}
    chosen["driver"] |= {"hardware": "simulated", "lockstep": False, "simulated.command_timeout": COMMAND_TIMEOUT}
    chosen["controller"]["sample_timeout"] = SAMPLE_TIMEOUT
    if chosen["controller"].get("trigger") == "lockstep":
        chosen["controller"]["trigger"] = "sample"
    return chosen


Judge = Callable[[Stand, Fault, list[str]], int | None]
"""``judge(stand, fault, failures)`` waits until the fault is found; returns when, ns since the epoch, or None. Then it
checks the reactions that must follow, adds failures to the list, and leaves the graph in a state in which it can be
switched on again."""


def _latched(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The driver must latch it, and refuse to switch on."""
    if not stand.until(lambda: stand.fault is not None, _PATIENCE_S) or stand.fault.fault is not fault:
        return None
    found = stand.fault.time_ns
    _check_refusal(stand, failures)
    return found


def _driver_missed(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The controller must report missing samples."""
    tripped = stand.until(lambda: stand.tripped is not None, _PATIENCE_S) and stand.tripped.fault is fault
    return stand.tripped.time_ns if tripped else None


def _logger_missed(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The logger's heartbeat must be missed, and the loop keep running."""
    found = time.time_ns() if stand.until(lambda: stand.heartbeats.silent() == ["logger"], _PATIENCE_S) else None
    _check_loop_runs(stand, failures)
    return found


def _recording_ended(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The logger must end with a complete bag, and the loop keep running."""
    if not stand.until(lambda: stand.exit_code("logger") is not None, _PATIENCE_S):
        return None
    found = time.time_ns()
    if not (stand.bag / "metadata.yaml").exists():
        failures.append(f"bag {stand.bag.name} is not whole")
    _check_loop_runs(stand, failures)
    stand.start("logger")
    return found


def _check_loop_runs(stand: Stand, failures: list[str]) -> None:
    if stand.condition != "on":
        reason = stand.fault.fault.label if stand.fault else "no fault"
        failures.append(f"without a logger the amplifier is '{stand.condition}': {reason}")


def _check_refusal(stand: Stand, failures: list[str]) -> None:
    if stand.enable():
        failures.append("the fault was not latched: the amplifier could be switched on")


def _then(judge: Judge, restore: Callable[[Stand, list[str]], object]) -> Judge:
    """The same judge; afterwards the graph is restored."""

    def both(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
        found = judge(stand, fault, failures)
        restore(stand, failures)
        return found

    return both


def _continued(name: str) -> Callable[[Stand, list[str]], object]:
    return lambda stand, failures: stand.signal(name, signal.SIGCONT)


def _restarted(name: str) -> Callable[[Stand, list[str]], object]:
    return lambda stand, failures: failures.extend(stand.restart(name))


def _driver_continued(stand: Stand, failures: list[str]) -> None:
    """Continue the driver, which must latch a fault of its own."""
    stand.signal("driver", signal.SIGCONT)
    if not stand.until(lambda: stand.condition == "fault", _PATIENCE_S):
        failures.append("the driver went on with the amplifier on")
    _check_refusal(stand, failures)


def _driver_restarted(stand: Stand, failures: list[str]) -> None:
    """Start the driver again; the amplifier must stay off."""
    stand.condition = ""
    failures += stand.restart("driver")
    if not stand.until(lambda: stand.condition != "", 30.0) or stand.condition == "on":
        failures.append(f"the new driver's amplifier is '{stand.condition}'")


class Trial(NamedTuple):
    """One way to cause a fault.

    Attributes:
        name: of the row.
        fault: that must be latched.
        make: causes it; returns when, ns since the epoch, or None if the driver reports when.
        judge: waits until the fault is found.
    """

    name: str
    fault: Fault
    make: Callable[[Stand], int | None]
    judge: Judge = _latched


def _injected(kind: str) -> Callable[[Stand], None]:
    return lambda stand: stand.inject(kind)


def _signalled(name: str, number: signal.Signals) -> Callable[[Stand], int]:
    return lambda stand: stand.signal(name, number)


def _commanded(current: float) -> Callable[[Stand], int]:
    def make(stand: Stand) -> int:
        at_ns = time.time_ns()
        # Newer than the controller's, so that it is not treated as a repeated answer.
        stand.command(at_ns, current)
        return at_ns

    return make


_RATES = (10, 100, 500, 2000, 5000)
"""Commands a second of a foreign publisher."""
_MS, _HOUR = 1_000_000, 3600 * 10**9
_STAMPS = {
    "now": (True, 0),
    "1 ms ago": (True, -_MS),
    "100 ms ago": (True, -100 * _MS),
    "10 s ago": (True, -10_000 * _MS),
    "an hour ago": (True, -_HOUR),
    "1 ms ahead": (True, _MS),
    "100 ms ahead": (True, 100 * _MS),
    "an hour ahead": (True, _HOUR),
    "0": (False, 0),
    "before 1970": (False, -_HOUR),
}


def _foreign(clock: bool, offset_ns: int) -> Callable[[Stand], int]:
    rates = itertools.cycle(_RATES)
    return lambda stand: stand.begin_foreign(next(rates), clock, offset_ns)


def _foreign_ended(stand: Stand, failures: list[str]) -> None:
    """The platform may not have come to its stop, nor come there later."""
    stand.spin(_DRIFT_S)
    sent = stand.end_foreign()
    if stand.fault is None:
        failures.append(f"{sent} foreign commands were not found")
    if stand.farthest >= stand.hard_stop:
        failures.append(f"the platform came to its stop: |y| = {stand.farthest * 1e6:.0f} µm")


def _set(node: str, name: str, value: object) -> Callable[[Stand], int]:
    """Set a parameter of a node; returns when, ns since the epoch."""

    def make(stand: Stand) -> int:
        client = stand.node.create_client(SetParameters, f"{node}/set_parameters")
        stand.until(client.service_is_ready, _PATIENCE_S)
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        at_ns = time.time_ns()
        for _ in range(_REQUESTS):
            future = client.call_async(request)
            if stand.until(lambda: future.done() or stand.exit_code(node) is not None, _ANSWER_S):  # noqa: B023
                break
        stand.node.destroy_client(client)
        return at_ns

    return make


_STOP, _KILL = signal.SIGSTOP, signal.SIGKILL
_TIGHT, _WIDE = (_set("controller", "error_limit", metres) for metres in (1e-9, 0.1))
TRIALS = (
    Trial("sample NaN", Fault.SAMPLE_NOT_FINITE, _injected("sample_nan")),
    Trial("sample infinite", Fault.SAMPLE_NOT_FINITE, _injected("sample_infinite")),
    Trial("y out of range", Fault.Y_OUT_OF_RANGE, _injected("y_out_of_range")),
    Trial("encoder y frozen", Fault.Y_FROZEN, _injected("y_frozen")),
    Trial("encoder x frozen", Fault.X_FROZEN, _injected("x_frozen")),
    Trial("jump in x", Fault.X_JUMP, _injected("x_jump")),
    Trial("map missing for this x", Fault.MAP_MISSING, _injected("x_beyond_map")),
    Trial("board reports a fault", Fault.BOARD, _injected("board")),
    Trial("clock jump", Fault.CLOCK_JUMP, _injected(CLOCK_STEP)),
    Trial("command NaN", Fault.COMMAND_NOT_FINITE, _commanded(math.nan)),
    Trial("command infinite", Fault.COMMAND_NOT_FINITE, _commanded(-math.inf)),
    Trial("command out of range", Fault.COMMAND_OUT_OF_RANGE, _commanded(5.0)),
    Trial("late commands", Fault.COMMAND_TIMEOUT, _injected(LATE_COMMANDS)),
    Trial(
        "two controllers on one topic",
        Fault.TWO_CONTROLLERS,
        lambda stand: stand.echo(True),
        _then(_latched, lambda stand, failures: stand.echo(False)),
    ),
    *(
        Trial(
            f"foreign commands, stamp {name}", Fault.TWO_CONTROLLERS, _foreign(*stamp), _then(_latched, _foreign_ended)
        )
        for name, stamp in _STAMPS.items()
    ),
    Trial("following error", Fault.FOLLOWING_ERROR, _TIGHT, _then(_latched, lambda stand, failures: _WIDE(stand))),
    *(
        Trial(f"{name} SIGSTOP", Fault.COMMAND_TIMEOUT, _signalled(name, _STOP), _then(_latched, _continued(name)))
        for name in ("controller", "feedforward")
    ),
    Trial(
        "driver SIGSTOP", Fault.SAMPLE_TIMEOUT, _signalled("driver", _STOP), _then(_driver_missed, _driver_continued)
    ),
    Trial(
        "logger SIGSTOP", Fault.HEARTBEAT_LOST, _signalled("logger", _STOP), _then(_logger_missed, _continued("logger"))
    ),
    *(
        Trial(f"{name} SIGKILL", Fault.COMMAND_TIMEOUT, _signalled(name, _KILL), _then(_latched, _restarted(name)))
        for name in ("controller", "feedforward")
    ),
    Trial(
        "driver SIGKILL", Fault.SAMPLE_TIMEOUT, _signalled("driver", _KILL), _then(_driver_missed, _driver_restarted)
    ),
    Trial(
        "logger SIGKILL", Fault.HEARTBEAT_LOST, _signalled("logger", _KILL), _then(_logger_missed, _restarted("logger"))
    ),
    Trial(
        "disk full under the logger",
        Fault.RECORDING_STOPPED,
        _set("logger", "min_free_bytes", 10**18),
        _recording_ended,
    ),
)
"""All trials, in this order."""


@dataclass
class Row:
    """Result for one fault.

    Attributes:
        name: of the fault and how it was caused.
        limit_ms: the fault must be latched within this time.
        reaction, reset: in words.
        injected: number of injections.
        times_ms: of each detection.
        failures: in words, one entry for each failure of an injection.
    """

    name: str
    limit_ms: float
    reaction: str
    reset: str
    injected: int = 0
    times_ms: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)

    @property
    def green(self) -> bool:
        """Whether each injection was detected in time, with all reactions as they must be."""
        detected = self.injected > 0 and len(self.times_ms) == self.injected
        return detected and max(self.times_ms) <= self.limit_ms and not self.failures

    def to_display(self) -> dict[str, Any]:
        """Values by name."""
        figures = {key: value for key, value in vars(self).items() if key != "times_ms"}
        times = self.times_ms or [math.nan]
        times_ms = {"median_ms": statistics.median(times), "max_ms": max(times)}
        return {**figures, "detected": len(self.times_ms), **times_ms, "green": self.green}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    parser.add_argument("--quick", action="store_true", help=f"{_QUICK} injections of each instead of {_REPEATS}")
    parser.add_argument("--only", metavar="TEXT", default="", help="inject only faults with this text in their name")
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    """Exit code 1 if a row is not green."""
    require_ros()
    chosen = [trial for trial in TRIALS if options.only in trial.name]
    if not chosen:
        names = ", ".join(trial.name for trial in TRIALS)
        raise CommandFailed(f"--only {options.only!r}: no fault has this in its name; known: {names}", exit_code=2)
    values, begin = trial_parameters(chosen_parameters(options)), time.monotonic()
    with output(options) as folder, progress() as advance:
        rows = run_trials(values, folder, _QUICK if options.quick else _REPEATS, advance, chosen)
    green, seconds = all(row.green for row in rows), time.monotonic() - begin
    print_json({"faults": [row.to_display() for row in rows], "all_green": green, "seconds": seconds})
    return int(not green)


def run_trials(
    values: Mapping[str, Mapping[str, Any]], folder: Path, repeats: int, advance: Progress, trials: Sequence[Trial]
) -> list[Row]:
    """Run ``trials``, each ``repeats`` times; bags and logs go into ``folder``.

    Raises:
        LaunchError: the graph does not start, or not again.
    """
    rows = []
    with Stand(folder, values) as stand:
        for place, trial in enumerate(trials):
            fault = trial.fault.value
            limit = fault.within_ms + _OTHERS.get(trial.fault, 0.0) + ALLOWANCE_MS
            row = Row(trial.name, limit, fault.reaction, fault.reset)
            rows.append(row)
            for repeat in range(repeats):
                advance(trial.name, (place + repeat / repeats) / len(trials))
                _repeat(stand, trial, row)
    return rows


def _repeat(stand: Stand, trial: Trial, row: Row) -> None:
    row.injected += 1
    for _ in range(_AGAIN):
        stand.switch_on()
        made_ns = trial.make(stand)
        found_ns = trial.judge(stand, trial.fault, row.failures)
        if found_ns is not None:
            if made_ns is None:
                stand.until(lambda: stand.injected_ns > 0, _PATIENCE_S)
            row.times_ms.append((found_ns - (made_ns or stand.injected_ns)) * 1e-6)
            return
