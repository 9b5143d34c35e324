"""Inject faults into the running graph, measure how soon each is latched, and say whether that is soon enough.

Starts driver, feedforward, controller and logger on the simulated machine, and injects each fault with the stage moving
and the amplifier on. Exit code 0 if every row is green."""

from __future__ import annotations

import argparse
import itertools
import math
import signal
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from operator import methodcaller
from typing import Any, NamedTuple

from straightcomp_ros.cell.launcher import COMPOSED, IN_THE_LOOP, RECORDED, LaunchError
from straightcomp_ros.cli.options import add_parameter_options, chosen_parameters, in_range
from straightcomp_ros.cli.output import CommandFailed, print_json, require_ros
from straightcomp_ros.hardware.simulated import SimulatedParameters
from straightcomp_ros.parameters.node_parameters import STAGE, CellNodeParameters, ControllerNodeParameters
from straightcomp_ros.safety.faults import Fault
from trials.faulty_driver import FAULTS
from trials.rig import add_output, output, tracked
from trials.stand import SILENT_AFTER_S, STOP_S, Stand

SUMMARY = "inject faults into the running graph and measure their detection"
COMMAND_TIMEOUT, SAMPLE_TIMEOUT = 0.25, 0.4
"""s, in the trials."""
_OTHERS = {
    Fault.COMMAND_TIMEOUT: 1e3 * (COMMAND_TIMEOUT - SimulatedParameters.command_timeout),
    Fault.SAMPLE_TIMEOUT: 1e3 * (SAMPLE_TIMEOUT - ControllerNodeParameters.sample_timeout),
    Fault.HEARTBEAT_LOST: 1e3 * (SILENT_AFTER_S - CellNodeParameters.heartbeat_timeout),
}
"""Time that these trials' parameters add to the faults' reaction times, which are those of the defaults."""
_ALLOWANCE_MS = 300.0
"""Allowance for stalls of a machine without real-time scheduling, beyond a fault's own time."""
_AGAIN = 3
"""Repetitions of an injection during which the computer stalled, so that another fault came first."""
_DRIFT_S = 0.2


def trial_parameters(values: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Parameters by node and dotted name for the trials, from those to start from."""
    chosen = {node: dict(values.get(node, {})) for node in (STAGE, *RECORDED)}
    chosen["driver"] |= {"hardware": "simulated", "simulated.command_timeout": COMMAND_TIMEOUT}
    chosen["controller"]["sample_timeout"] = SAMPLE_TIMEOUT
    return chosen


Judge = Callable[[Stand, Sequence[Fault]], int | None]
"""``judge(stand, faults)`` waits until one of these is found; returns when, ns since the epoch, or None. Then it checks
the reactions that must follow."""


def _latched(stand: Stand, faults: Sequence[Fault]) -> int | None:
    """The driver must latch it, and refuse to switch on."""
    if not stand.until(lambda: stand.fault is not None) or stand.fault.fault not in faults:
        return None
    found: int = stand.fault.time_ns
    stand.must_not_switch_on()
    return found


def _driver_missed(stand: Stand, faults: Sequence[Fault]) -> int | None:
    """The controller must report missing samples."""
    tripped = stand.until(lambda: stand.tripped is not None) and stand.tripped.fault is faults[0]
    return stand.tripped.time_ns if tripped else None


def _logger_missed(stand: Stand, _: Sequence[Fault]) -> int | None:
    """The logger's heartbeat must be missed, and the loop keep running."""
    found = time.time_ns() if stand.until(lambda: stand.heartbeats.silent() == ["logger"]) else None
    _check_loop_runs(stand)
    return found


def _recording_ended(stand: Stand, _: Sequence[Fault]) -> int | None:
    """The logger must end with a complete bag, and the loop keep running."""
    if not stand.until(lambda: stand.graph.exit_code("logger") is not None, STOP_S):
        return None
    found = time.time_ns()
    if not (stand.bag / "metadata.yaml").exists():
        stand.fail(f"bag {stand.bag.name} is not whole")
    _check_loop_runs(stand)
    stand.start("logger")
    return found


def _check_loop_runs(stand: Stand) -> None:
    if stand.condition != "on":
        reason = stand.fault.fault.label if stand.fault else "no fault"
        stand.fail(f"without a logger the amplifier is '{stand.condition}': {reason}")


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
        stand.fail("the driver went on with the amplifier on")
    stand.must_not_switch_on()


_RATES = (10, 100, 500, 2000, 5000)
"""Commands a second of a foreign publisher."""
_MS, _HOUR = 1_000_000, 3600 * 10**9
_STAMPS = {
    "now": (1, 0),
    "1 ms ago": (1, -_MS),
    "100 ms ago": (1, -100 * _MS),
    "10 s ago": (1, -10_000 * _MS),
    "an hour ago": (1, -_HOUR),
    "1 ms ahead": (1, _MS),
    "100 ms ahead": (1, 100 * _MS),
    "an hour ahead": (1, _HOUR),
    "0": (0, 0),
    "before 1970": (0, -_HOUR),
}
_FOREIGN_CURRENT = 0.5
"""A, within the limit: nothing but its stamp shows that a command is foreign."""


def _foreign(clock: int, offset_ns: int) -> Callable[[Stand], int]:
    rates = itertools.cycle(_RATES)
    return lambda stand: stand.foreign(next(rates), clock, offset_ns, _FOREIGN_CURRENT)


def _foreign_ended(stand: Stand) -> None:
    """The platform may not have come to its stop, nor come there later."""
    stand.spin(_DRIFT_S)
    sent = stand.foreign_ended()
    if stand.fault is None:
        stand.fail(f"{sent} foreign commands were not found")
    if stand.farthest >= stand.hard_stop:
        stand.fail(f"the platform came to its stop: |y| = {stand.farthest * 1e6:.0f} µm")


def _set(node: str, name: str, value: object) -> Callable[[Stand], int]:
    """Set a parameter of a node; returns when, ns since the epoch."""

    def make(stand: Stand) -> int:
        at_ns = time.time_ns()
        # What follows shows whether it was set: a logger that ends at once may not answer.
        with suppress(LaunchError):
            stand.set(node, {name: value})
        return at_ns

    return make


def _loop_missed(stand: Stand, _: Sequence[Fault]) -> int | None:
    """The heartbeats of all three nodes must be missed."""
    return time.time_ns() if stand.until(lambda: {*IN_THE_LOOP} <= {*stand.heartbeats.silent()}) else None


def trials_of_processes(composed: bool) -> Iterator[Trial]:
    """Each process is stopped, and continued afterwards; and it is killed, and started again."""
    processes: dict[str, tuple[Fault, Judge]] = {
        "controller": (Fault.COMMAND_TIMEOUT, _latched),
        "feedforward": (Fault.COMMAND_TIMEOUT, _latched),
        "driver": (Fault.SAMPLE_TIMEOUT, _driver_missed),
    }
    if composed:
        processes = {COMPOSED: (Fault.HEARTBEAT_LOST, _loop_missed)}
    for name, (fault, judge) in (processes | {"logger": (Fault.HEARTBEAT_LOST, _logger_missed)}).items():
        go_on = _driver_continued if name in ("driver", COMPOSED) else methodcaller("signal", name, signal.SIGCONT)
        yield Trial(f"{name} SIGSTOP", fault, methodcaller("signal", name, signal.SIGSTOP), judge, go_on)
        restart = methodcaller("restart", name)
        yield Trial(f"{name} SIGKILL", fault, methodcaller("signal", name, signal.SIGKILL), judge, restart)


def trials_of(composed: bool) -> list[Trial]:
    """All trials, in this order; ``composed``: driver, feedforward and controller are in one process."""
    foreign = {f"foreign commands, stamp {name}": _foreign(*stamp) for name, stamp in _STAMPS.items()}
    foreign = {"two controllers on one topic": methodcaller("foreign"), **foreign}
    tight, wide = (_set("controller", "error_limit", metres) for metres in (1e-9, 0.1))
    fill = _set("logger", "min_free_bytes", 10**18)
    return [
        *(Trial(name, fault, methodcaller("inject", name)) for name, fault in FAULTS.items()),
        *(Trial(name, Fault.TWO_CONTROLLERS, make, restore=_foreign_ended) for name, make in foreign.items()),
        Trial("following error", Fault.FOLLOWING_ERROR, tight, restore=wide),
        *trials_of_processes(composed),
        Trial("disk full under the logger", Fault.RECORDING_STOPPED, fill, _recording_ended),
    ]


def row_of(trial: Trial, injected: int, times_ms: Sequence[float], failures: Sequence[str]) -> dict[str, Any]:
    """Values by name: it is green if each injection was detected in time, with all reactions as they must be."""
    what, times = trial.fault.value, times_ms or [math.nan]
    limit_ms = what.within_ms + _OTHERS.get(trial.fault, 0.0) + _ALLOWANCE_MS
    return {
        "name": trial.name,
        "limit_ms": limit_ms,
        "injected": injected,
        "failures": failures,
        "detected": len(times_ms),
        "median_ms": statistics.median(times),
        "max_ms": max(times),
        "green": len(times_ms) == injected and max(times) <= limit_ms and not failures,
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    kind = in_range(int, 1)
    parser.add_argument("--injections", type=kind, default=20, metavar="N", help="of each fault (default: %(default)s)")
    parser.add_argument("--only", metavar="TEXT", default="", help="inject only faults with this text in their name")
    parser.add_argument("--composed", action="store_true", help="driver, feedforward and controller in one process")
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    """Print a row for each fault; exit code 1 if one is not green."""
    require_ros()
    known = trials_of(options.composed)
    chosen = [trial for trial in known if options.only in trial.name]
    if not chosen:
        names = ", ".join(trial.name for trial in known)
        raise CommandFailed(f"--only {options.only!r}: no fault has this in its name; known: {names}", exit_code=2)
    values, begin, rows = trial_parameters(chosen_parameters(options)), time.monotonic(), list[dict[str, Any]]()
    # If the graph does not start again, what was measured before stays of use.
    with output(options) as folder, Stand(folder, values, options.composed) as stand, suppress(LaunchError):
        for trial in tracked(chosen, "faults"):
            stand.failures, injected, times_ms = [], 0, list[float]()
            try:
                for injected in range(1, options.injections + 1):  # noqa: B007
                    times_ms += _injected(stand, trial)
            except LaunchError as error:
                stand.fail(str(error))
                raise
            finally:
                rows.append(row_of(trial, injected, times_ms, stand.failures))
    green, seconds = all(row["green"] for row in rows), time.monotonic() - begin
    print_json({"faults": rows, "all_green": green, "seconds": seconds})
    return int(not green)


def _injected(stand: Stand, trial: Trial) -> list[float]:
    """The time in ms after which it was found; none if it was not."""
    for _ in range(_AGAIN):
        stand.switch_on()
        made_ns = trial.make(stand)
        found_ns = trial.judge(stand, [trial.fault])
        trial.restore(stand)
        if found_ns is not None:
            if made_ns is None:
                stand.until(lambda: stand.injected_ns > 0)
            return [(found_ns - (made_ns or stand.injected_ns)) * 1e-6]
    return []
