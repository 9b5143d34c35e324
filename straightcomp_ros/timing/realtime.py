"""Scheduling of a node's process: priorities, CPUs, memory, and no deep sleep of the CPUs.

What the system does not permit is left out and said, with the remedy; the node runs without it.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import BinaryIO

from straightcomp_ros.settings.declaration import parameter
from straightcomp_ros.timing.exclusive import keep_others_off, kept_free, left_behind

_MCL_CURRENT, _MCL_FUTURE = 1, 2
_CPU_LATENCY = "/dev/cpu_dma_latency"
_THREADS = "/proc/self/task"
"""Ids of the threads of this process, the middleware's too."""

_held: list[BinaryIO] = []
"""Files whose request lasts as long as they are open."""


@dataclass(frozen=True)
class RealtimeParameters:
    """Scheduling of a node's process."""

    priority: int = parameter(
        0,
        "SCHED_FIFO priority, the same for all nodes that talk to each other; 0: normal scheduling",
        minimum=0,
        maximum=98,
    )
    cpus: str = parameter(
        "",
        "CPUs that the node may use, separated by commas, e.g. '2,3'; 'loop' for the last one that the process may use,"
        " 'rest' for all but that; empty for all",
    )
    lock_memory: bool = parameter(False, "Lock the process's memory, so that none of it is paged out")
    keep_awake: bool = parameter(
        False, "Keep all CPUs of the machine from sleeping while the node runs: faster wake-ups, more electric power"
    )
    exclusive: bool = parameter(
        False, "Keep other programs off the node's CPUs while it runs, as far as its user may move them"
    )


def apply(realtime: RealtimeParameters, inform: Callable[[str], None] = lambda _: None) -> list[str]:
    """Set what the parameters ask for; call it when all threads of the node have been started.

    Args:
        realtime: what is asked for.
        inform: gets what was done to other programs.

    Returns:
        A sentence for each thing that was refused, with the remedy.
    """
    steps: list[tuple[bool, Callable[[RealtimeParameters], None], str, str]] = [
        (
            bool(realtime.cpus),
            _set_cpus,
            f"CPUs '{realtime.cpus}'",
            "name CPUs that this process may use, 'loop' or 'rest'",
        ),
        (realtime.priority > 0, _set_priority, f"priority {realtime.priority}", "give this user rtprio in limits.conf"),
        (realtime.lock_memory, _lock_memory, "locking memory", "give this user memlock in limits.conf"),
        (
            realtime.keep_awake,
            _keep_awake,
            f"keeping the CPUs awake by {_CPU_LATENCY}",
            "make it writable by a udev rule",
        ),
        (
            realtime.exclusive,
            lambda _: inform(keep_others_off(os.sched_getaffinity(0))),
            "keeping other programs off the node's CPUs",
            "leave a CPU to them (realtime.cpus)",
        ),
    ]
    refusals = []
    for asked, step, what, remedy in steps:
        if asked:
            try:
                step(realtime)
            except (OSError, AttributeError, ValueError) as error:
                refusals.append(f"real-time: {what} was refused ({error}); running without. Remedy: {remedy}")
    return refusals


def _set_cpus(realtime: RealtimeParameters) -> None:
    permitted = os.sched_getaffinity(0) | kept_free() | left_behind()
    loop = {max(permitted)}
    # With a single CPU the rest is on it too.
    rest = permitted - loop or loop
    cpus = {"loop": loop, "rest": rest}.get(realtime.cpus) or {int(cpu) for cpu in realtime.cpus.split(",")}
    for thread in map(int, os.listdir(_THREADS)):
        # One may end meanwhile.
        with suppress(ProcessLookupError):
            os.sched_setaffinity(thread, cpus)


def _set_priority(realtime: RealtimeParameters) -> None:
    # The middleware's threads too, with the main thread's priority; threads that the node itself started have no part
    # in its timing.
    helpers = {thread.native_id for thread in threading.enumerate()} - {threading.get_native_id()}
    for thread in map(int, os.listdir(_THREADS)):
        if thread not in helpers:
            with suppress(ProcessLookupError):
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(realtime.priority))


def _lock_memory(_: RealtimeParameters) -> None:
    if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _keep_awake(_: RealtimeParameters) -> None:
    file = open(_CPU_LATENCY, "wb", buffering=0)  # noqa: SIM115 (closing it would end the request)
    file.write((0).to_bytes(4, sys.byteorder))
    _held.append(file)
