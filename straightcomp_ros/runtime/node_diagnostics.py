"""Publishes a node's counters and timing at 1 Hz as diagnostic_msgs/DiagnosticArray."""

import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from straightcomp_ros.contract import DIAGNOSTICS
from straightcomp_ros.messages.cdr import ENCAPSULATION, NANOSECONDS, append_aligned
from straightcomp_ros.runtime.inside_rclpy import raw_publish
from straightcomp_ros.runtime.loops import now_ns
from straightcomp_ros.runtime.managed import ManagedNode
from straightcomp_ros.timing.delays import CpuWait
from straightcomp_ros.timing.node_timing import (
    CPU_CORES,
    CPU_WAIT,
    CPUS,
    DESCRIPTION,
    NORMAL,
    PROCESS,
    RATE,
    REALTIME_LIMIT,
    REFUSED,
    SAMPLES,
    SCHEDULING,
    Levels,
)
from straightcomp_ros.timing.realtime import realtime_limit

_TICK_S, TICKS = 0.05, 20
"""A report takes a tick for each of its steps, and the next one begins after all ticks."""
_AT_ONCE = 20
"""Values that are written in one step."""
_LOOK_S = 0.05
"""Interval at which the threads' waiting times for a CPU are read."""
_PRIORITY = "realtime.priority"


class Diagnostics:
    """Collects the values once a second and publishes them, with the rate at which ``samples`` grow.

    Each step takes some 0.1 ms with cold caches: in one turn of a loop's idle work they would delay the next cycles.

    ``counters`` and ``parts`` return values by name; the first always ``samples``, and ``error`` to report an error. A
    name ends with the unit, unless the value is a count: ``_us``, ``_hz``. An empty ``hardware_id`` stands for this
    computer's name. ``description`` is that of the stage; empty if the node works with none.
    """

    def __init__(
        self,
        node: Node,
        counters: Callable[[], Mapping[str, object]],
        *parts: Callable[[], Mapping[str, object]],
        hardware_id: str = "",
        description: str = "",
    ) -> None:
        self._node, self._counters, self._parts = node, counters, parts
        self._hardware_id = hardware_id or platform.node()
        self._levels, self._cpu_wait = Levels(), CpuWait()
        publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, 10)
        self._publish = node.streams.sending(publisher) if isinstance(node, ManagedNode) else raw_publish(publisher)
        self._before = (time.monotonic(), 0, time.process_time())
        self._fixed = {**({DESCRIPTION: description} if description else {}), REALTIME_LIMIT: realtime_limit()}
        # rclpy takes 0.1 ms to look a parameter up.
        self._asked = bool(node.has_parameter(_PRIORITY) and node.get_parameter(_PRIORITY).value)
        self._ticks, self._steps = 0, None
        self._cpu_wait.take_us()
        node.create_timer(_LOOK_S, self._cpu_wait.look)
        node.create_timer(_TICK_S, self.tick)

    def tick(self) -> None:
        """Do the next step of a report; a report of many values delays the next one."""
        if self._steps is None and self._ticks % TICKS == 0:
            self._steps = self._report()
        self._ticks += 1
        if self._steps is not None and next(self._steps, self) is self:
            self._steps = None

    def _report(self) -> Iterator[None]:
        """Publish a report; each ``yield`` waits for the next tick."""
        clock, counters = self._node.get_clock(), self._counters()
        # By the clock of the samples, also after a step of the system's; with use_sim_time by /clock, once that comes.
        stamp_ns = (clock.ros_time_is_active and clock.now().nanoseconds) or now_ns()
        now = time.monotonic(), int(str(counters[SAMPLES])), time.process_time()
        (seconds, samples, busy), self._before = (b - a for a, b in zip(self._before, now, strict=True)), now
        values = {**counters, RATE: f"{samples / seconds:.1f}", CPU_CORES: f"{busy / seconds:.2f}"}
        for part in self._parts:
            yield
            values |= part()
        yield
        values[CPU_WAIT] = f"{self._cpu_wait.take_us():.0f}"
        yield
        cpus = ",".join(map(str, sorted(os.sched_getaffinity(0))))
        values |= {**self._fixed, CPUS: cpus, PROCESS: os.getpid(), SCHEDULING: self._scheduling()}
        yield
        level, words = self._levels.next(values)
        name = self._node.get_fully_qualified_name().lstrip("/")
        # A header with no frame, and one status. rclpy serialises such a message in one go, in 0.2 ms: longer than a
        # period at 8 kHz.
        message = bytearray(ENCAPSULATION)
        append_aligned(message, *divmod(stamp_ns, NANOSECONDS), "", 1)
        message.append(level)
        append_aligned(message, name, words, self._hardware_id, len(values))
        for number, (key, value) in enumerate(values.items()):
            if number % _AT_ONCE == 0:
                yield
            append_aligned(message, key, str(value))
        yield
        self._publish(bytes(message))

    def _scheduling(self) -> str:
        if os.sched_getscheduler(0) == os.SCHED_FIFO:
            return f"FIFO {os.sched_getparam(0).sched_priority}"
        return REFUSED if self._asked else NORMAL
