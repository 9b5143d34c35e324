"""Inject every fault into the running graph, measure how soon it is latched, and say whether that is soon enough.

Starts driver, feedforward, controller and logger on the simulated machine, and injects each fault with the stage moving
and the amplifier on. Exit code 0 if every row is green."""

from __future__ import annotations

import argparse
import itertools
import math
import re
import signal
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from operator import methodcaller
from pathlib import Path
from typing import Any, NamedTuple

from rcl_interfaces.srv import SetParametersAtomically

from straightcomp_ros.cell.launcher import COMPOSED, IN_THE_LOOP, RECORDED, LaunchError
from straightcomp_ros.cli.options import add_parameter_options, chosen_parameters
from straightcomp_ros.cli.output import CommandFailed, print_json, require_ros
from straightcomp_ros.parameters.node_parameters import STAGE
from straightcomp_ros.safety.faults import ALLOWANCE_MS, Fault
from trials.faulty_driver import CLOCK_STEP, LATE_COMMANDS
from trials.rig import Progress, add_output, output, progress
from trials.stand import STOP_S, Stand, request_of

SUMMARY = "inject every fault in the running graph and measure its detection"
_REPEATS, _QUICK = 20, 3
COMMAND_TIMEOUT, SAMPLE_TIMEOUT = 0.25, 0.4
"""s, in the trials."""
_OTHERS = {
    Fault.COMMAND_TIMEOUT: COMMAND_TIMEOUT * 1e3 - 5.0,
    Fault.SAMPLE_TIMEOUT: SAMPLE_TIMEOUT * 1e3 - 1000.0,
}
"""Time that these trials' parameters add to the faults' reaction times, which are those of the defaults."""
_REQUESTS = 8
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


Judge = Callable[[Stand, Fault], int | None]
"""``judge(stand, fault)`` waits until the fault is found; returns when, ns since the epoch, or None. Then it checks the
reactions that must follow."""


def _latched(stand: Stand, fault: Fault) -> int | None:
    """The driver must latch it, and refuse to switch on."""
    if not stand.until(lambda: stand.fault is not None) or stand.fault.fault is not fault:
        return None
    found: int = stand.fault.time_ns
    stand.must_not_switch_on()
    return found


def driver_missed(stand: Stand, fault: Fault) -> int | None:
    """The controller must report missing samples."""
    tripped = stand.until(lambda: stand.tripped is not None) and stand.tripped.fault is fault
    return stand.tripped.time_ns if tripped else None


def _logger_missed(stand: Stand, fault: Fault) -> int | None:
    """The logger's heartbeat must be missed, and the loop keep running."""
    found = time.time_ns() if stand.until(lambda: stand.heartbeats.silent() == ["logger"]) else None
    _check_loop_runs(stand)
    return found


def _recording_ended(stand: Stand, fault: Fault) -> int | None:
    """The logger must end with a complete bag, and the loop keep running."""
    if not stand.until(lambda: stand.exit_code("logger") is not None, STOP_S):
        return None
    found = time.time_ns()
    if not (stand.bag / "metadata.yaml").exists():
        stand.failures.append(f"bag {stand.bag.name} is not whole")
    _check_loop_runs(stand)
    stand.start("logger")
    return found


def _check_loop_runs(stand: Stand) -> None:
    if stand.condition != "on":
        reason = stand.fault.fault.label if stand.fault else "no fault"
        stand.failures.append(f"without a logger the amplifier is '{stand.condition}': {reason}")


class Trial(NamedTuple):
    """One way to cause a fault.

    Attributes:
        name: of the row.
        fault: that must be latched.
        make: causes it; returns when, ns since the epoch, or None if the driver reports when.
        judge: waits until the fault is found.
        restore: leaves the graph in a state in which it can be switched on again.
    """

    name: str
    fault: Fault
    make: Callable[[Stand], int | None]
    judge: Judge = _latched
    restore: Callable[[Stand], object] = lambda stand: None


def _driver_continued(stand: Stand) -> None:
    """Continue the driver, which must latch a fault of its own."""
    stand.signal(stand.process_of["driver"], signal.SIGCONT)
    if not stand.until(lambda: stand.condition == "fault"):
        stand.failures.append("the driver went on with the amplifier on")
    stand.must_not_switch_on()


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


_FOREIGN_CURRENT = 0.5
"""A, within the limit: nothing but its stamp shows that a command is foreign."""


def _foreign(clock: bool, offset_ns: int) -> Callable[[Stand], int]:
    rates = itertools.cycle(_RATES)
    return lambda stand: stand.foreign(f"{next(rates)} {clock:d} {offset_ns} {_FOREIGN_CURRENT}")


def _foreign_ended(stand: Stand) -> None:
    """The platform may not have come to its stop, nor come there later."""
    stand.spin(_DRIFT_S)
    sent = stand.foreign()
    if stand.fault is None:
        stand.failures.append(f"{sent} foreign commands were not found")
    if stand.farthest >= stand.hard_stop:
        stand.failures.append(f"the platform came to its stop: |y| = {stand.farthest * 1e6:.0f} µm")


def _set(node: str, name: str, value: object) -> Callable[[Stand], int]:
    """Set a parameter of a node; returns when, ns since the epoch."""

    def make(stand: Stand) -> int:
        at_ns = time.time_ns()
        for _ in range(_REQUESTS):
            answer = stand.call(SetParametersAtomically, f"{node}/set_parameters_atomically", request_of({name: value}))
            if answer is not None or stand.exit_code(node) is not None:
                break
        return at_ns

    return make


_STOP, _KILL = signal.SIGSTOP, signal.SIGKILL
_TIGHT, _WIDE = (_set("controller", "error_limit", metres) for metres in (1e-9, 0.1))
TRIALS = (
    Trial("sample NaN", Fault.SAMPLE_NOT_FINITE, methodcaller("inject", "sample_nan")),
    Trial("sample infinite", Fault.SAMPLE_NOT_FINITE, methodcaller("inject", "sample_infinite")),
    Trial("y out of range", Fault.Y_OUT_OF_RANGE, methodcaller("inject", "y_out_of_range")),
    Trial("encoder y frozen", Fault.Y_FROZEN, methodcaller("inject", "y_frozen")),
    Trial("encoder x frozen", Fault.X_FROZEN, methodcaller("inject", "x_frozen")),
    Trial("jump in x", Fault.X_JUMP, methodcaller("inject", "x_jump")),
    Trial("map missing for this x", Fault.MAP_MISSING, methodcaller("inject", "x_beyond_map")),
    Trial("board reports a fault", Fault.BOARD, methodcaller("inject", "board")),
    Trial("clock jump", Fault.CLOCK_JUMP, methodcaller("inject", CLOCK_STEP)),
    Trial("command NaN", Fault.COMMAND_NOT_FINITE, methodcaller("inject", "command_nan")),
    Trial("command infinite", Fault.COMMAND_NOT_FINITE, methodcaller("inject", "command_infinite")),
    Trial("command out of range", Fault.COMMAND_OUT_OF_RANGE, methodcaller("inject", "command_out_of_range")),
    Trial("late commands", Fault.COMMAND_TIMEOUT, methodcaller("inject", LATE_COMMANDS)),
    Trial(
        "two controllers on one topic",
        Fault.TWO_CONTROLLERS,
        methodcaller("echo", True),
        restore=methodcaller("echo", False),
    ),
    *(
        Trial(f"foreign commands, stamp {name}", Fault.TWO_CONTROLLERS, _foreign(*stamp), restore=_foreign_ended)
        for name, stamp in _STAMPS.items()
    ),
    Trial("following error", Fault.FOLLOWING_ERROR, _TIGHT, restore=_WIDE),
    *(
        Trial(f"{name} SIGSTOP", fault, methodcaller("signal", name, _STOP), judge, restore)
        for name, fault, judge, restore in (
            ("controller", Fault.COMMAND_TIMEOUT, _latched, methodcaller("signal", "controller", signal.SIGCONT)),
            ("feedforward", Fault.COMMAND_TIMEOUT, _latched, methodcaller("signal", "feedforward", signal.SIGCONT)),
            ("driver", Fault.SAMPLE_TIMEOUT, driver_missed, _driver_continued),
            ("logger", Fault.HEARTBEAT_LOST, _logger_missed, methodcaller("signal", "logger", signal.SIGCONT)),
        )
    ),
    *(
        Trial(f"{name} SIGKILL", fault, methodcaller("signal", name, _KILL), judge, methodcaller("restart", name))
        for name, fault, judge in (
            ("controller", Fault.COMMAND_TIMEOUT, _latched),
            ("feedforward", Fault.COMMAND_TIMEOUT, _latched),
            ("driver", Fault.SAMPLE_TIMEOUT, driver_missed),
            ("logger", Fault.HEARTBEAT_LOST, _logger_missed),
        )
    ),
    Trial(
        "disk full under the logger",
        Fault.RECORDING_STOPPED,
        _set("logger", "min_free_bytes", 10**18),
        _recording_ended,
    ),
)
"""All trials, in this order."""


def loop_missed(stand: Stand, fault: Fault) -> int | None:
    """The heartbeats of all three nodes must be missed."""
    return time.time_ns() if stand.until(lambda: {*IN_THE_LOOP} <= {*stand.heartbeats.silent()}) else None


_OF_ONE_NODE = re.compile(r"(driver|feedforward|controller) SIG")
COMPOSED_TRIALS = (
    *(trial for trial in TRIALS if not _OF_ONE_NODE.match(trial.name)),
    *(
        Trial(
            f"servo {number.name}", Fault.HEARTBEAT_LOST, methodcaller("signal", COMPOSED, number), loop_missed, restore
        )
        for number, restore in ((_STOP, _driver_continued), (_KILL, methodcaller("restart", COMPOSED)))
    ),
)
"""Those of driver, feedforward and controller in one process."""


class Row:
    """Result of a trial: number of injections, time of each detection in ms, and failures in words."""

    def __init__(self, trial: Trial) -> None:
        self._trial, self.injected, self.failures = trial, 0, []
        self.times_ms: list[float] = []
        self.limit_ms = trial.fault.value.within_ms + _OTHERS.get(trial.fault, 0.0) + ALLOWANCE_MS

    def to_display(self) -> dict[str, Any]:
        """Values by name. It is green if each injection was detected in time, with all reactions as they must be."""
        times = self.times_ms or [math.nan]
        return {
            "name": self._trial.name,
            "limit_ms": self.limit_ms,
            "reaction": self._trial.fault.value.reaction,
            "reset": self._trial.fault.value.reset,
            "injected": self.injected,
            "failures": self.failures,
            "detected": len(self.times_ms),
            "median_ms": statistics.median(times),
            "max_ms": max(times),
            "green": len(self.times_ms) == self.injected and max(times) <= self.limit_ms and not self.failures,
        }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    parser.add_argument("--quick", action="store_true", help=f"{_QUICK} injections of each instead of {_REPEATS}")
    parser.add_argument("--only", metavar="TEXT", default="", help="inject only faults with this text in their name")
    parser.add_argument("--composed", action="store_true", help="driver, feedforward and controller in one process")
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    """Exit code 1 if a row is not green."""
    require_ros()
    all_trials = COMPOSED_TRIALS if options.composed else TRIALS
    chosen = [trial for trial in all_trials if options.only in trial.name]
    if not chosen:
        names = ", ".join(trial.name for trial in all_trials)
        raise CommandFailed(f"--only {options.only!r}: no fault has this in its name; known: {names}", exit_code=2)
    values, begin = trial_parameters(chosen_parameters(options)), time.monotonic()
    with output(options) as folder, progress() as advance:
        rows = run_trials(values, folder, _QUICK if options.quick else _REPEATS, advance, chosen, options.composed)
    green, seconds = all(row["green"] for row in rows), time.monotonic() - begin
    print_json({"faults": rows, "all_green": green, "seconds": seconds})
    return int(not green)


def run_trials(
    values: Mapping[str, Mapping[str, Any]],
    folder: Path,
    repeats: int,
    advance: Progress,
    trials: Sequence[Trial],
    composed: bool = False,
) -> list[dict[str, Any]]:
    """Rows of ``trials``, each run ``repeats`` times; bags and logs go into ``folder``. A graph that does not start
    again is the last row's failure; LaunchError if it does not start at all."""
    rows: list[Row] = []
    with Stand(folder, values, composed) as stand:
        for place, trial in enumerate(trials):
            row = Row(trial)
            stand.failures = row.failures
            rows.append(row)
            try:
                for repeat in range(repeats):
                    advance(trial.name, (place + repeat / repeats) / len(trials))
                    _repeat(stand, trial, row)
            except LaunchError as error:
                # What was measured before stays of use.
                row.failures.append(str(error))
                break
    return [row.to_display() for row in rows]


def _repeat(stand: Stand, trial: Trial, row: Row) -> None:
    row.injected += 1
    for _ in range(_AGAIN):
        stand.switch_on()
        made_ns = trial.make(stand)
        found_ns = trial.judge(stand, trial.fault)
        trial.restore(stand)
        if found_ns is not None:
            if made_ns is None:
                stand.until(lambda: stand.injected_ns > 0)
            row.times_ms.append((found_ns - (made_ns or stand.injected_ns)) * 1e-6)
            return
