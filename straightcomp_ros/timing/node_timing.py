"""The timing in a node's diagnostics: names of its values, level, and what a reader concludes: rates, what delayed."""

import enum
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

from straightcomp_ros.parameters.yaml_text import number_or_nan
from straightcomp_ros.timing.delays import NOTHING, Distribution

SAMPLES = "samples"
"""Samples that the node has processed since its start."""
RATE = "rate_hz"
OVERRUNS, STALLS, STALLED_MS = "overruns", "stalls", "stalled_ms"
"""Periods that the loop missed by its own work; gaps in which the host held it up, and their total length."""
LOST = "lost_samples"
TIMER_ERROR = "timer_error"
LATENCY = "latency"
AMPLIFIER = "amplifier"
"""State of the amplifier, in the driver's diagnostics."""
UNREFERENCED = "unreferenced"
"""Why x is not counted from its reference, in the driver's diagnostics; empty if it is."""
EXCITATION = "excitation"
"""State of the excitation, in the controller's diagnostics: empty before the first, then `EXCITING`, then `FINISHED` or
why it ended early."""
EXCITING, FINISHED = "running", "finished"
DESCRIPTION = "stage"
"""Name and checksum of the stage's description that the node works with."""
CPU_WAIT = "cpu_wait_max_us"
"""The longest time since the previous report for which a thread was ready to run but got no CPU."""
SCHEDULING = "scheduling"
NORMAL, REFUSED = "normal", "normal, real-time priority refused"
"""Scheduling of a node without real-time priority: not requested, or not permitted."""
PROCESS, CPUS, CPU_CORES = "process_id", "cpus", "cpu_cores"
"""The node's process, the CPUs that it may use, and how many it kept busy since the previous report."""
REALTIME_LIMIT = "realtime_limit"
"""Time in µs that the kernel leaves to real-time tasks on each CPU, and of which period: '950000/1000000'."""
_NEARLY = 0.85
"""Of that limit: a report's second is not the kernel's period, and other real-time threads count there too."""
_LONGER = 1.2
"""A stop by the limit lasts for the rest of the period at most; the loop's next cycle may begin a little later."""
_NOTED_US = 5_000.0
"""Shorter delays (ten samples at 2 kHz) happen on every desktop."""
_STALL_NS = 2_000_000
"""No cycle takes that long by its own work, at any rate."""
_CLEAN_REPORTS = 5
_OVERRUN_SHARE = 0.01
_STALLED_MS = 10
"""Of one second; shorter stalls happen on every desktop."""
_MOST, _DIGITS = 2**63 - 1, 20
_PERCENTS = {"p50": 50.0, "p99": 99.0, "p999": 99.9}


def reporting_node(status: str, namespace: str) -> str:
    """Name of the node in ``namespace`` that publishes a status of this name; empty for another namespace."""
    before, _, name = status.rpartition("/")
    return name if before == namespace.strip("/") else ""


def number(values: Mapping[str, str], name: str) -> float:
    """The value ``name`` of a status, which any program may have written; NaN if there is none or it is no finite
    number."""
    value = number_or_nan(values.get(name))
    return value if math.isfinite(value) else math.nan


def count(values: Mapping[str, str], name: str) -> int:
    """The same for a counter; 0 if there is none or it is no number from 0 to 2⁶³ − 1."""
    text = values.get(name, "")
    value = int(text) if text.isdecimal() and len(text) < _DIGITS else 0
    return value if value <= _MOST else 0


def percentiles_us(distribution: Distribution) -> dict[str, float]:
    """``p50``, ``p99``, ``p999`` and ``max`` in µs; NaN without any durations."""
    values = distribution.percentiles_us(tuple(_PERCENTS.values()))
    return {**dict(zip(_PERCENTS, values, strict=True)), "max": distribution.largest_us}


def written(name: str, distribution: Distribution) -> dict[str, str]:
    """Diagnostic values of one quantity: its percentiles for people, its histogram for :func:`summarise`."""
    values = {f"{name}_{key}_us": f"{value:.1f}" for key, value in percentiles_us(distribution).items()}
    return {**values, f"{name}_histogram": distribution.to_text()}


class MissedPeriods:
    """Counts missed periods of a loop by their cause.

    A gap of 2 ms or more, or one that begins with a wake-up that came a period too late, is a stall: other programs,
    the kernel or the hypervisor had the CPU. Periods missed in others are overruns: the cycles took longer than a
    period.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self.overruns = self.stalls = self._stalled_ns = 0

    def count(self, missed: int, woken_late_ns: int = 0) -> None:
        """Count ``missed`` periods that were missed at once, if any, after a wake-up that came late by so much."""
        lasted_ns = missed * self._period_ns
        if lasted_ns >= _STALL_NS or (missed and woken_late_ns >= self._period_ns):
            self.stalls += 1
            self._stalled_ns += lasted_ns
        else:
            self.overruns += missed

    def report(self) -> dict[str, object]:
        """Values for the diagnostics, since the start."""
        return {OVERRUNS: self.overruns, STALLS: self.stalls, STALLED_MS: self._stalled_ns // 1_000_000}


class Level(enum.IntEnum):
    """The levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


class Levels:
    """The level of each report of one node, with hysteresis, so that it does not change every second.

    A report with lost samples, with overruns in more than 1 % of the samples, or with stalls of more than 10 ms, is a
    warning. So are the next ones until five in a row had none. An error is reported while it lasts, and warnings
    follow it in the same way.
    """

    def __init__(self) -> None:
        self._counters = [0, 0, 0, 0]
        self._clean = _CLEAN_REPORTS

    def next(self, values: Mapping[str, object]) -> tuple[Level, str]:
        """Level and text of a report, from its values: counters since the node's start, and ``error``."""
        counters = [int(str(values.get(name, 0))) for name in (SAMPLES, LOST, OVERRUNS, STALLED_MS)]
        samples, lost, overruns, stalled_ms = (
            now - before for now, before in zip(counters, self._counters, strict=True)
        )
        self._counters = counters
        problems = (
            (lost > 0, f"{lost} samples lost in the last second"),
            (overruns > _OVERRUN_SHARE * max(samples, 1), f"{overruns} overruns in the last second"),
            (stalled_ms > _STALLED_MS, f"the host held the loop up for {stalled_ms} ms in the last second"),
        )
        problem, error = next((words for found, words in problems if found), ""), str(values.get("error", ""))
        self._clean = 0 if problem or error else self._clean + 1
        if error:
            return Level.ERROR, error
        if problem:
            return Level.WARN, problem
        if self._clean < _CLEAN_REPORTS:
            return Level.WARN, "running again; it had a problem in the last seconds"
        return Level.OK, "running"


class Report(NamedTuple):
    """One node's diagnostics."""

    time_ns: int  # of publication, ns since the epoch
    values: Mapping[str, str]
    hardware_id: str = ""  # what the node reports on: a machine, or the computer that it runs on


class HeldUp(NamedTuple):
    """What delayed a node, as far as its diagnostics show."""

    no_cpu_us: float = 0.0  # longest time for which a thread of the node was ready to run but got no CPU
    late_us: float = 0.0  # largest lateness of its loop, whatever the cause
    scheduling: str = ""  # "FIFO 40", NORMAL or REFUSED; empty if unknown
    process: str = ""  # its id; empty if unknown
    cpus: str = ""  # that it may use: "0,1"
    cores: float = 0.0  # that its process kept busy, in the second with most
    limit: tuple[float, float] = (0.0, 0.0)  # µs of real-time tasks on a CPU, of each period in µs; zeros: none known


@dataclass(frozen=True)
class NodeTiming:
    """Timing of a node over some time."""

    rate_hz: float  # samples processed per second; NaN with fewer than two reports
    overruns: int  # periods that its loop missed by its own work
    stalls: int  # gaps in which the host held its loop up
    lost_samples: int  # that did not reach it
    timer_error: Distribution  # lateness of its loop's wake-ups
    latency: Distribution  # from a sample until its command arrived; driver only
    held_up: HeldUp = HeldUp()

    def to_display(self) -> dict[str, Any]:
        """Values by name, durations in µs."""
        return {
            "rate_hz": self.rate_hz,
            OVERRUNS: self.overruns,
            STALLS: self.stalls,
            "lost_samples": self.lost_samples,
            "timer_error_us": percentiles_us(self.timer_error),
            "no_cpu_us": self.held_up.no_cpu_us,
            SCHEDULING: self.held_up.scheduling,
        }


def held_up(reports: Sequence[Mapping[str, str]]) -> HeldUp:
    """What delayed a node over some of its reports, given by their values."""
    late = [number(values, f"{TIMER_ERROR}_max_us") for values in reports]
    waits = [number(values, CPU_WAIT) for values in reports]
    last = next((values for values in reversed(reports) if SCHEDULING in values), {})
    cores = [number(values, CPU_CORES) for values in reports]
    runtime, _, period = last.get(REALTIME_LIMIT, "").partition("/")
    limit = number({"": runtime}, ""), number({"": period}, "")
    # Many short waits add up to a long one, but none was longer than the lateness of the loop. If the scheduler counted
    # less than half of that lateness, something else delayed the loop.
    no_cpu = [min(late_us, wait_us) for late_us, wait_us in zip(late, waits, strict=True) if wait_us >= 0.5 * late_us]
    return HeldUp(
        max(no_cpu, default=0.0),
        max((one for one in late if one >= 0.0), default=0.0),
        last.get(SCHEDULING, ""),
        last.get(PROCESS, ""),
        last.get(CPUS, ""),
        cores=max((one for one in cores if one >= 0.0), default=0.0),
        limit=limit if 0.0 < limit[0] <= limit[1] else (0.0, 0.0),
    )


def throttled(nodes: Mapping[str, HeldUp]) -> str:
    """That the kernel's limit for real-time tasks stopped one of the named nodes, and the remedy; empty if none.

    Such a node was ready to run, its loop stood still for the rest of the limit's period at most, and the real-time
    processes on its CPUs used nearly all that the limit leaves them.
    """
    for name, node in sorted(nodes.items(), key=lambda one: -one[1].no_cpu_us):
        runtime, period = node.limit
        if not (node.scheduling.startswith("FIFO") and node.no_cpu_us >= _NOTED_US and runtime < period):
            continue
        sharing = {who: one for who, one in nodes.items() if one.scheduling[:4] == "FIFO" and one.cpus == node.cpus}
        of_processes = {one.process: one.cores for one in sharing.values()}.values()
        used = max(*of_processes, sum(of_processes) / (node.cpus.count(",") + 1))
        if node.late_us <= _LONGER * (period - runtime) and used >= _NEARLY * runtime / period:
            return (
                f"the {name} was stopped for {node.no_cpu_us * 1e-3:.0f} ms by the kernel's limit for real-time tasks: "
                f"{', '.join(sharing)} used {used:.2f} of CPU {node.cpus}, allowed {runtime / period:.2f} "
                "(kernel.sched_rt_runtime_us); remedy: one process for the loop (composed), a lower stage.rate, a CPU "
                "of its own for each node, or no limit (docs/realtime.md, Throttling)"
            )
    return ""


def blamed(nodes: Mapping[str, HeldUp]) -> str:
    """Which of the named nodes were delayed, for how long and by what, and the remedy; empty if none was for long."""
    waiting = {
        name: node.no_cpu_us
        for name, node in nodes.items()
        if node.scheduling in (NORMAL, REFUSED) and node.no_cpu_us >= _NOTED_US
    }
    if waiting:
        longest_first = sorted(waiting, key=lambda name: -waiting[name])
        words = ", ".join(f"the {name} got no CPU for {waiting[name] * 1e-3:.0f} ms" for name in longest_first)
        if any(nodes[name].scheduling == REFUSED for name in waiting):
            return f"{words}; real-time priority is not permitted; remedy: straightcomp doctor"
        return f"{words}; real-time priority was not requested; remedy: the parameter realtime.priority"
    if words := throttled(nodes):
        return words
    name, latest = max(nodes.items(), key=lambda node: node[1].late_us, default=("", HeldUp()))
    if latest.late_us < _NOTED_US:
        return ""
    return (
        f"the {name} was late by {latest.late_us * 1e-3:.0f} ms, and no other program had its CPU: "
        "the kernel, the disk or the hypervisor held it up; remedy: straightcomp doctor"
    )


def amplifier_on(driver: Sequence[Report]) -> tuple[int, int]:
    """Times of the first and last report with the amplifier on, ns since the epoch; all time if it is never on."""
    times = [report.time_ns for report in driver if report.values.get(AMPLIFIER) == "on"]
    return (times[0], times[-1]) if times else (0, 2**63)


def summarise(reports: Sequence[Report], begin_ns: int = 0, end_ns: int = 2**63) -> NodeTiming:
    """Timing of a node from its first to its last report in [begin_ns, end_ns], times in ns since the epoch.

    ``reports`` are in the order of their times. The first only marks the beginning, since its values describe the time
    before it. Values that are no numbers, or no histograms of :meth:`Distribution.to_text`, count as absent.
    """
    inside = [report for report in reports if begin_ns <= report.time_ns <= end_ns]
    if len(inside) < 2:
        return NodeTiming(math.nan, 0, 0, 0, NOTHING, NOTHING)
    first, last = inside[0], inside[-1]

    def grown(name: str) -> int:
        return count(last.values, name) - count(first.values, name)

    def total(name: str) -> Distribution:
        found = NOTHING
        for report in inside[1:]:
            with suppress(ValueError):
                found += Distribution.from_text(report.values.get(f"{name}_histogram", ""))
        return found

    seconds = (last.time_ns - first.time_ns) * 1e-9
    return NodeTiming(
        rate_hz=grown(SAMPLES) / seconds if seconds > 0 else math.nan,
        overruns=grown(OVERRUNS),
        stalls=grown(STALLS),
        lost_samples=grown(LOST),
        timer_error=total(TIMER_ERROR),
        latency=total(LATENCY),
        held_up=held_up([report.values for report in inside[1:]]),
    )
