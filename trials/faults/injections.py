"""Injects each fault into the running graph repeatedly, and measures the time until it is latched."""

from __future__ import annotations

import itertools
import math
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from straightcomp_ros.cell.launcher import RECORDED
from straightcomp_ros.parameters.node_parameters import STAGE
from straightcomp_ros.safety.faults import ALLOWANCE_MS, Fault
from trials.faults.faulty_driver import CLOCK_STEP, LATE_COMMANDS
from trials.faults.reactions import (
    PATIENCE_S,
    Judge,
    driver_missed_and_going_on,
    driver_missed_and_restarted,
    latched,
    latched_and_going_on,
    latched_and_restarted,
    logger_missed_and_going_on,
    logger_missed_and_restarted,
    recording_ended,
)
from trials.faults.rows import Row
from trials.faults.stand import Stand

COMMAND_TIMEOUT, SAMPLE_TIMEOUT = 0.25, 0.4
"""s, in the trials."""
_ANSWER_S, _REQUESTS = 1.0, 8
"""Timeout and number of requests: a node that has just started may lose one, or its answer."""
_AGAIN = 3
"""Repetitions of an injection during which the computer stalled, so that another fault came first."""
_OTHERS = {
    Fault.COMMAND_TIMEOUT: COMMAND_TIMEOUT * 1e3 - 5.0,
    Fault.SAMPLE_TIMEOUT: SAMPLE_TIMEOUT * 1e3 - 1000.0,
}
"""Time that these trials' parameters add to the faults' reaction times, which are those of the defaults."""


def trial_parameters(values: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Parameters by node and dotted name for the trials, from those to start from."""
    chosen = {node: dict(values.get(node, {})) for node in (STAGE, *RECORDED)}
    chosen["driver"] |= {"hardware": "simulated", "lockstep": False, "simulated.command_timeout": COMMAND_TIMEOUT}
    chosen["controller"]["sample_timeout"] = SAMPLE_TIMEOUT
    if chosen["controller"].get("trigger") == "lockstep":
        chosen["controller"]["trigger"] = "sample"
    return chosen


class Trial(NamedTuple):
    """One way to cause a fault.

    Attributes:
        name: of the row.
        fault: that must be latched.
        make: causes it; returns when, ns since the epoch, or None if the driver reports when.
        judge: waits until the fault is found, see :data:`~trials.faults.reactions.Judge`.
    """

    name: str
    fault: Fault
    make: Callable[[Stand], int | None]
    judge: Judge


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


def _echoed(stand: Stand) -> None:
    stand.echo(True)


def _latched_and_silent(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    found = latched(stand, fault, failures)
    stand.echo(False)
    return found


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
_DRIFT_S = 0.2


def _foreign(clock: bool, offset_ns: int) -> Callable[[Stand], int]:
    rates = itertools.cycle(_RATES)
    return lambda stand: stand.begin_foreign(next(rates), clock, offset_ns)


def _latched_in_the_middle(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The same, and the platform may not have come to its stop, nor come there later."""
    found = latched(stand, fault, failures)
    stand.spin(_DRIFT_S)
    sent = stand.end_foreign()
    if stand.fault is None:
        failures.append(f"{sent} foreign commands were not found")
    if stand.farthest >= stand.stop:
        failures.append(f"the platform came to its stop: |y| = {stand.farthest * 1e6:.0f} µm")
    return found


def _disk_full(stand: Stand) -> int:
    return _set(stand, "logger", "min_free_bytes", 10**18)


_TIGHT_M, _WIDE_M = 1e-9, 0.1


def _error_limited(stand: Stand) -> int:
    return _set(stand, "controller", "error_limit", _TIGHT_M)


def _latched_and_unlimited(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    found = latched(stand, fault, failures)
    _set(stand, "controller", "error_limit", _WIDE_M)
    return found


def _set(stand: Stand, node: str, name: str, value: object) -> int:
    """Set a parameter of a node; returns when, ns since the epoch."""
    client = stand.node.create_client(SetParameters, f"{node}/set_parameters")
    stand.until(client.service_is_ready, PATIENCE_S)
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    at_ns = time.time_ns()
    for _ in range(_REQUESTS):
        answered = client.call_async(request).done
        if stand.until(partial(_answered_or_ended, stand, node, answered), _ANSWER_S):
            break
    stand.node.destroy_client(client)
    return at_ns


def _answered_or_ended(stand: Stand, node: str, answered: Callable[[], bool]) -> bool:
    return answered() or stand.exit_code(node) is not None


_STOP, _KILL = signal.SIGSTOP, signal.SIGKILL
TRIALS = (
    Trial("sample NaN", Fault.SAMPLE_NOT_FINITE, _injected("sample_nan"), latched),
    Trial("sample infinite", Fault.SAMPLE_NOT_FINITE, _injected("sample_infinite"), latched),
    Trial("y out of range", Fault.Y_OUT_OF_RANGE, _injected("y_out_of_range"), latched),
    Trial("encoder y frozen", Fault.Y_FROZEN, _injected("y_frozen"), latched),
    Trial("encoder x frozen", Fault.X_FROZEN, _injected("x_frozen"), latched),
    Trial("jump in x", Fault.X_JUMP, _injected("x_jump"), latched),
    Trial("map missing for this x", Fault.MAP_MISSING, _injected("x_beyond_map"), latched),
    Trial("board reports a fault", Fault.BOARD, _injected("board"), latched),
    Trial("clock jump", Fault.CLOCK_JUMP, _injected(CLOCK_STEP), latched),
    Trial("command NaN", Fault.COMMAND_NOT_FINITE, _commanded(math.nan), latched),
    Trial("command infinite", Fault.COMMAND_NOT_FINITE, _commanded(-math.inf), latched),
    Trial("command out of range", Fault.COMMAND_OUT_OF_RANGE, _commanded(5.0), latched),
    Trial("late commands", Fault.COMMAND_TIMEOUT, _injected(LATE_COMMANDS), latched),
    Trial("two controllers on one topic", Fault.TWO_CONTROLLERS, _echoed, _latched_and_silent),
    *(
        Trial(f"foreign commands, stamp {name}", Fault.TWO_CONTROLLERS, _foreign(*stamp), _latched_in_the_middle)
        for name, stamp in _STAMPS.items()
    ),
    Trial("following error", Fault.FOLLOWING_ERROR, _error_limited, _latched_and_unlimited),
    *(
        Trial(f"{name} SIGSTOP", Fault.COMMAND_TIMEOUT, _signalled(name, _STOP), latched_and_going_on(name))
        for name in ("controller", "feedforward")
    ),
    Trial("driver SIGSTOP", Fault.SAMPLE_TIMEOUT, _signalled("driver", _STOP), driver_missed_and_going_on),
    Trial("logger SIGSTOP", Fault.HEARTBEAT_LOST, _signalled("logger", _STOP), logger_missed_and_going_on),
    *(
        Trial(f"{name} SIGKILL", Fault.COMMAND_TIMEOUT, _signalled(name, _KILL), latched_and_restarted(name))
        for name in ("controller", "feedforward")
    ),
    Trial("driver SIGKILL", Fault.SAMPLE_TIMEOUT, _signalled("driver", _KILL), driver_missed_and_restarted),
    Trial("logger SIGKILL", Fault.HEARTBEAT_LOST, _signalled("logger", _KILL), logger_missed_and_restarted),
    Trial("disk full under the logger", Fault.RECORDING_STOPPED, _disk_full, recording_ended),
)
"""All trials, in this order."""


def run_trials(
    values: Mapping[str, Mapping[str, Any]],
    folder: Path,
    repeats: int,
    progress: Callable[[str, float], None] = lambda name, fraction: None,
    trials: Sequence[Trial] = TRIALS,
) -> list[Row]:
    """Run all trials.

    Args:
        values: from :func:`trial_parameters`.
        folder: for bags and logs.
        repeats: injections of each fault.
        progress: called before each injection with the row's name and the finished fraction.
        trials: the trials to run.

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
                progress(trial.name, (place + repeat / repeats) / len(trials))
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
                stand.until(lambda: stand.injected_ns > 0, PATIENCE_S)
            row.times_ms.append((found_ns - (made_ns or stand.injected_ns)) * 1e-6)
            return
