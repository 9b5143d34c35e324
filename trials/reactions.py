"""How the graph must react to a fault: each function here waits until it is found, and checks what must follow."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable

from straightcomp_ros.safety.faults import Fault
from trials.stand import Stand

PATIENCE_S = 8.0
Judge = Callable[[Stand, Fault, list[str]], int | None]
"""``judge(stand, fault, failures)`` waits until the fault is found; returns when, ns since the epoch, or None. Then it
checks the reactions that must follow, adds failures to the list, and leaves the graph in a state in which it can be
switched on again."""


def latched(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The driver must latch it, and refuse to switch on."""
    if not stand.until(lambda: stand.fault is not None, PATIENCE_S) or stand.fault.fault is not fault:
        return None
    found = stand.fault.time_ns
    _check_refusal(stand, failures)
    return found


def latched_and_going_on(stopped: str) -> Judge:
    """The same, and continue the stopped node."""

    def judge(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
        found = latched(stand, fault, failures)
        stand.signal(stopped, signal.SIGCONT)
        return found

    return judge


def latched_and_restarted(killed: str) -> Judge:
    """The same, and start the killed node again."""

    def judge(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
        found = latched(stand, fault, failures)
        failures += stand.restart(killed)
        return found

    return judge


def _driver_missed(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The controller must report missing samples."""
    if not stand.until(lambda: stand.tripped is not None, PATIENCE_S) or stand.tripped.fault is not fault:
        return None
    return stand.tripped.time_ns


def driver_missed_and_going_on(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The same, and continue the driver, which must latch a fault of its own."""
    found = _driver_missed(stand, fault, failures)
    stand.signal("driver", signal.SIGCONT)
    if not stand.until(lambda: stand.condition == "fault", PATIENCE_S):
        failures.append("the driver went on with the amplifier on")
    _check_refusal(stand, failures)
    return found


def driver_missed_and_restarted(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The same, and start the driver again; the amplifier must stay off."""
    found = _driver_missed(stand, fault, failures)
    stand.condition = ""
    failures += stand.restart("driver")
    if not stand.until(lambda: stand.condition != "", 30.0) or stand.condition == "on":
        failures.append(f"the new driver's amplifier is '{stand.condition}'")
    return found


def _logger_missed(stand: Stand) -> int | None:
    """Wait until the logger's heartbeat is missing."""
    return time.time_ns() if stand.until(lambda: stand.heartbeats.silent() == ["logger"], PATIENCE_S) else None


def logger_missed_and_going_on(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The logger's heartbeat must be missed and the loop keep running; then continue the logger."""
    found = _logger_missed(stand)
    _check_going_on(stand, failures)
    stand.signal("logger", signal.SIGCONT)
    return found


def logger_missed_and_restarted(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The same, and start the killed logger again."""
    found = _logger_missed(stand)
    _check_going_on(stand, failures)
    failures += stand.restart("logger")
    return found


def recording_ended(stand: Stand, fault: Fault, failures: list[str]) -> int | None:
    """The logger must end with a complete bag, and the loop keep running."""
    if not stand.until(lambda: stand.exit_code("logger") is not None, PATIENCE_S):
        return None
    found = time.time_ns()
    if not (stand.bag / "metadata.yaml").exists():
        failures.append(f"bag {stand.bag.name} is not whole")
    _check_going_on(stand, failures)
    stand.start("logger")
    return found


def _check_going_on(stand: Stand, failures: list[str]) -> None:
    if stand.condition != "on":
        reason = stand.fault.fault.label if stand.fault else "no fault"
        failures.append(f"without a logger the amplifier is '{stand.condition}': {reason}")


def _check_refusal(stand: Stand, failures: list[str]) -> None:
    if stand.enable():
        failures.append("the fault was not latched: the amplifier could be switched on")
