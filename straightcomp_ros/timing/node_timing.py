"""What a node's diagnostics say of its timing: the names of the values, written by nodes and read from bags."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any

from straightcomp_ros.timing.blame import HeldUp
from straightcomp_ros.timing.histogram import NOTHING, Distribution

SAMPLES = "samples"
"""Samples that the node has handled since its start."""
RATE = "rate_hz"
OVERRUNS = "overruns"
LOST = "lost_samples"
TIMER_ERROR = "timer_error"
LATENCY = "latency"
AMPLIFIER = "amplifier"
"""State of the amplifier, in the driver's report."""
CPU_WAIT = "cpu_wait_max_us"
"""The longest time since the report before for which a thread was ready to run and got no CPU."""
SCHEDULING = "scheduling"
_PERCENTS = {"p50": 50.0, "p99": 99.0, "p999": 99.9}


def percentiles_us(distribution: Distribution) -> dict[str, float]:
    """``p50``, ``p99``, ``p999`` and ``max`` in µs; NaN where nothing was recorded."""
    values = distribution.percentiles_us(tuple(_PERCENTS.values()))
    return {**dict(zip(_PERCENTS, values, strict=True)), "max": distribution.largest_us}


def written(name: str, distribution: Distribution) -> dict[str, object]:
    """Values of the diagnostics for one quantity: its percentiles for people, its histogram for :func:`summarise`."""
    values: dict[str, object] = {
        f"{name}_{key}_us": f"{value:.1f}" for key, value in percentiles_us(distribution).items()
    }
    return {**values, f"{name}_histogram": distribution.to_text()}


@dataclass(frozen=True)
class Report:
    """One node's diagnostics at one time.

    Attributes:
        time_ns: when they were published, ns since the epoch.
        values: all values by name, as texts.
    """

    time_ns: int
    values: Mapping[str, str]


@dataclass(frozen=True)
class NodeTiming:
    """A node over a length of time.

    Attributes:
        rate_hz: samples that it handled per second; NaN with fewer than two reports.
        overruns: periods that its loop missed.
        lost_samples: samples that did not come to it.
        timer_error: how much too late its loop woke up.
        latency: from a sample until its command came in (driver only).
        held_up: by what, and for how long.
    """

    rate_hz: float
    overruns: int
    lost_samples: int
    timer_error: Distribution
    latency: Distribution
    held_up: HeldUp = HeldUp()

    def to_display(self) -> dict[str, Any]:
        """Values by name, durations in µs."""
        return {
            "rate_hz": self.rate_hz,
            "overruns": self.overruns,
            "lost_samples": self.lost_samples,
            "timer_error_us": percentiles_us(self.timer_error),
            "no_cpu_us": self.held_up.no_cpu_us,
            SCHEDULING: self.held_up.scheduling,
        }


def held_up(reports: Sequence[Mapping[str, str]]) -> HeldUp:
    """What held a node up over some of its reports, given by their values.

    Raises:
        ValueError: a value is no number.
    """
    late = [float(values.get(f"{TIMER_ERROR}_max_us", "nan")) for values in reports]
    waits = [float(values.get(CPU_WAIT, "nan")) for values in reports]
    scheduling = next((values[SCHEDULING] for values in reversed(reports) if SCHEDULING in values), "")
    # Many short waits look like a long one. But none was longer than the loop was late then, and where most of that
    # lateness is missing in the scheduler's count, something else held the loop up.
    no_cpu = [min(late_us, wait_us) for late_us, wait_us in zip(late, waits, strict=True) if wait_us >= 0.5 * late_us]
    known = [late_us for late_us in late if not math.isnan(late_us)]
    return HeldUp(max(no_cpu, default=0.0), max(known, default=0.0), scheduling)


def amplifier_on(driver: Sequence[Report]) -> tuple[int, int]:
    """First and last report, ns since the epoch, of a driver whose amplifier is on; all time where it never is."""
    times = [report.time_ns for report in driver if report.values.get(AMPLIFIER) == "on"]
    return (times[0], times[-1]) if times else (0, 2**63)


def summarise(reports: Sequence[Report], begin_ns: int = 0, end_ns: int = 2**63) -> NodeTiming:
    """A node from its first report in [begin_ns, end_ns] to its last.

    The first report says what was before it: it counts as the beginning only.

    Args:
        reports: of one node, in the order of their times.
        begin_ns, end_ns: ns since the epoch.

    Raises:
        ValueError: a value is no number or no histogram of ours.
    """
    inside = [report for report in reports if begin_ns <= report.time_ns <= end_ns]
    if len(inside) < 2:
        return NodeTiming(math.nan, 0, 0, NOTHING, NOTHING)
    first, last = inside[0], inside[-1]

    def grown(name: str) -> int:
        return int(last.values.get(name, 0)) - int(first.values.get(name, 0))

    def total(name: str) -> Distribution:
        texts = [report.values.get(f"{name}_histogram") for report in inside[1:]]
        return reduce(add, (Distribution.from_text(text) for text in texts if text), NOTHING)

    seconds = (last.time_ns - first.time_ns) * 1e-9
    return NodeTiming(
        rate_hz=grown(SAMPLES) / seconds if seconds > 0 else math.nan,
        overruns=grown(OVERRUNS),
        lost_samples=grown(LOST),
        timer_error=total(TIMER_ERROR),
        latency=total(LATENCY),
        held_up=held_up([report.values for report in inside[1:]]),
    )
