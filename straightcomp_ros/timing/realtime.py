"""Scheduling of a node's process: priorities, CPUs, memory, and no deep sleep of the CPUs.

If the system refuses one of these, the node runs without it, and reports it with the remedy.
"""

import ctypes
import os
import re
import sys
import threading
from collections.abc import Callable, Set
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from straightcomp_ros.parameters.declaration import parameter
from straightcomp_ros.timing.cpus import keep_others_off, kept_free, left_behind, loop_cpu, loop_cpus

_MCL_CURRENT, _MCL_FUTURE = 1, 2
_CPU_LATENCY = "/dev/cpu_dma_latency"
_THREADS = "/proc/self/task"
"""Ids of the threads of this process, the middleware's included."""

_POLLING = "dds.asyn"
"""Fast DDS's thread for asynchronous sending. It polls a lock that another thread holds (ros2/rmw_fastrtps issue 666):
at the same priority on the same CPU it would keep that thread, and all others there, from running for ever. It takes
turns (SCHED_RR), since there is no priority below 1."""

_FAIR_SERVER = "950000/1000000"
"""Default of /sys/kernel/debug/sched/fair_server, which replaces the limit from Linux 6.12 on, and which only root can
read: the same as the limit's."""

LOOP, REST = "loop", "rest"
"""Values of ``realtime.cpus``."""


def place(node: str) -> str:
    """Where the shipped parameters put a node: driver and controller on one CPU, where one wakes the other soonest."""
    return LOOP if node in ("driver", "controller") else REST


_held: list[BinaryIO] = []
"""Files that must stay open: closing one withdraws its request."""


@dataclass(frozen=True)
class RealtimeParameters:
    """Scheduling of a node's process."""

    priority: int = parameter(
        0,
        "SCHED_FIFO priority, the same for all nodes of a graph; a node on the CPUs 'rest' takes one less, so that it "
        "never holds up a loop; 0: normal scheduling",
        "[0, 98]",
    )
    cpus: str = parameter(
        "",
        "CPUs that the node may use, separated by commas, e.g. '2,3'; 'loop' for the one of the graph's control loop: "
        "the last that no other graph's loop has; 'rest' for all without a loop; empty for all",
    )
    lock_memory: bool = parameter(False, "Lock the process's memory, so that none of it is paged out")
    keep_awake: bool = parameter(
        False, "Keep all CPUs of the machine from sleeping while the node runs: faster wake-ups, more electric power"
    )
    exclusive: bool = parameter(
        False, "Keep other programs off the node's CPUs while it runs, as far as its user may move them"
    )


def apply(
    realtime: RealtimeParameters,
    inform: Callable[[str], None] = lambda _: None,
    graph: str = "",
    loop_alone: bool = False,
) -> list[str]:
    """Apply the parameters, after all threads of the node have started; returns a sentence for each refused request.

    ``inform`` is called with what was done to other programs. ``graph`` distinguishes the node's graph from others on
    this machine, whose loops have other CPUs; empty for a program that belongs to none. With ``loop_alone`` the calling
    thread's loop waits for no message: where it has a priority and the CPU 'loop', the process's other threads are on
    'rest', as another node would be. At normal scheduling all stay together: elsewhere another program could preempt a
    thread that holds the interpreter lock.
    """
    refusals: list[str] = []

    def attempt(what: str, step: Callable[[], None], remedy: str) -> None:
        try:
            step()
        except (OSError, AttributeError, ValueError) as error:
            refusals.append(f"real-time: {what} was refused ({error}); running without. Remedy: {remedy}")

    cpus = realtime.cpus
    # Threads that a node without such a loop has started itself do not affect its timing.
    own = set() if loop_alone else {thread.native_id for thread in threading.enumerate()}
    others = set(map(int, os.listdir(_THREADS))) - own - {threading.get_native_id()}
    priority = realtime.priority - (cpus == REST and realtime.priority > 1)
    if priority > 0:
        fifo = os.SCHED_FIFO, os.sched_param(priority)
        attempt(f"priority {priority}", lambda: os.sched_setscheduler(0, *fifo), "give this user rtprio in limits.conf")
    granted = priority > 0 and os.sched_getscheduler(0) == os.SCHED_FIFO
    if cpus:
        remedy = f"name CPUs that this process may use, '{LOOP}' or '{REST}'"
        attempt(f"CPUs '{cpus}'", lambda: _set_cpus(cpus, graph, loop_alone and granted), remedy)
    if granted:
        _set_priorities(priority, others)
    if realtime.lock_memory:
        attempt("locking memory", _lock_memory, "give this user memlock in limits.conf")
    if realtime.keep_awake:
        attempt(f"keeping the CPUs awake by {_CPU_LATENCY}", _keep_awake, "make it writable by a udev rule")
    if realtime.exclusive:
        what = "keeping other programs off the node's CPUs"
        attempt(what, lambda: inform(keep_others_off(os.sched_getaffinity(0))), "leave a CPU to them (realtime.cpus)")
    return refusals


def realtime_limit(folder: Path = Path("/proc/sys/kernel"), release: str | None = None) -> str:
    """Time in µs that the kernel leaves to real-time tasks on each CPU, and of which period: '950000/1000000'; empty if
    it has no limit. Linux 6.12 and later leave the rest to others even where the limit is switched off."""
    files = [folder / f"sched_rt_{name}_us" for name in ("runtime", "period")]
    with suppress(OSError, ValueError):
        runtime, period = (int(file.read_text()) for file in files)
        if runtime >= 0:
            return f"{runtime}/{period}"
        version = [int(number) for number in re.findall(r"\d+", release or os.uname().release)[:2]]
        return _FAIR_SERVER if version >= [6, 12] else ""
    return ""


def _set_cpus(names: str, graph: str, loop_alone: bool) -> None:
    if names in (LOOP, REST):
        permitted = os.sched_getaffinity(0) | kept_free() | left_behind()
        loop = {loop_cpu(graph, permitted) if graph else max(loop_cpus() or permitted)}
        # Where each CPU has a loop, 'rest' is those of other graphs; on a machine with a single CPU, that one.
        rest = permitted - loop_cpus() - loop or permitted - loop or loop
        cpus = loop if names == LOOP else rest
    else:
        cpus = rest = {int(cpu) for cpu in names.split(",")}
    for thread in map(int, os.listdir(_THREADS)):
        # A thread may have ended.
        with suppress(ProcessLookupError):
            os.sched_setaffinity(thread, rest if loop_alone and thread != threading.get_native_id() else cpus)


def _set_priorities(priority: int, others: Set[int]) -> None:
    cpus = os.sched_getaffinity(0)
    for thread in others:
        with suppress(FileNotFoundError, ProcessLookupError):
            # On the loop's CPU, one with a lower priority would be preempted while the loop waits for what it holds.
            rank = priority if os.sched_getaffinity(thread) == cpus else max(1, priority - 1)
            if Path(_THREADS, str(thread), "comm").read_text().startswith(_POLLING):
                os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(max(1, rank - 1)))
            else:
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(rank))


def _lock_memory() -> None:
    if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _keep_awake() -> None:
    file = open(_CPU_LATENCY, "wb", buffering=0)  # noqa: SIM115 (closing it would end the request)
    file.write((0).to_bytes(4, sys.byteorder))
    _held.append(file)
