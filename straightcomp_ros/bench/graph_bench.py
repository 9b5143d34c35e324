"""Measures the running graph: rate, lateness, CPU, memory of each node; latency and losses of the whole."""

import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.recorded_nodes import read_reports
from straightcomp_ros.bench.processes import cores, usage
from straightcomp_ros.bench.recorded_window import Recording, read_window
from straightcomp_ros.bench.window import Window, growth_mb_per_hour
from straightcomp_ros.cell.demonstration import free_port
from straightcomp_ros.cell.launcher import RECORDED, LaunchError, run_cycle, verb_command
from straightcomp_ros.contract import PACKAGE, STROKE
from straightcomp_ros.model.motion import forward_and_back
from straightcomp_ros.parameters.node_parameters import (
    NODE_PARAMETERS,
    STAGE,
    node_parameters,
)
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.timing.node_timing import NodeTiming, summarise

_SETTLE_S = 1.5
"""Motion before the window, in which caches fill and loops lock to each other."""
_REST_S = 1.0
"""Time after the window in which its last samples are answered and recorded."""
_PAUSE_S = 0.5
_DRIVER_TIMEOUT_S = 1.0
"""Command timeout of the machine: a stall must be measured, not switch the amplifier off."""


class BenchFailed(RuntimeError):
    """The measurement failed; the message names the node and the reason."""


@dataclass(frozen=True)
class Measurement:
    """One measured run.

    Attributes:
        timing: each node in the window, from its diagnostics.
        cpu_cores: CPU cores that each node kept busy.
        rss_mb: resident memory of each node at begin and end, MB.
        growth_mb_per_hour: slope of that memory; meaningful only over many minutes.
        recording: the bag's streams in the window.
        seconds: length of the window.
    """

    timing: Mapping[str, NodeTiming]
    cpu_cores: Mapping[str, float]
    rss_mb: Mapping[str, tuple[float, float]]
    growth_mb_per_hour: Mapping[str, float]
    recording: Recording
    seconds: float

    def to_display(self) -> dict[str, Any]:
        """All figures by name, as `straightcomp bench graph --json` prints them."""
        figures: dict[str, Any] = {}
        for node, timing in self.timing.items():
            shown = timing.to_display()
            figures[node] = {key: shown[key] for key in ("rate_hz", "overruns", "stalls", "timer_error_us")}
            figures[node] |= {
                "cpu_cores": self.cpu_cores[node],
                "rss_mb": list(self.rss_mb[node]),
            }
        recording = self.recording
        return {
            **figures,
            "lost_samples": recording.lost_samples,
            "overruns": sum(timing.overruns for timing in self.timing.values()),
            "stalls": sum(timing.stalls for timing in self.timing.values()),
            "latency_us": recording.latency_us(),
            "cpu_cores": sum(self.cpu_cores.values()),
            "seconds": self.seconds,
            "bag": {
                "complete": not any(recording.missing.values()),
                "expected_samples": recording.expected,
                "missing": dict(recording.missing),
                "amplifier_on": recording.amplifier_on,
            },
        }


def bench_parameters(
    values: Mapping[str, Mapping[str, Any]], *, rate: int, seconds: float, priority: int
) -> dict[str, dict[str, Any]]:
    """Parameters of a measured run.

    Args:
        values: parameters to start from, by node and dotted name.
        rate: samples per second, of machine and controller.
        seconds: length of the window; the stage moves a little longer.
        priority: SCHED_FIFO priority of all nodes, with CPUs kept awake; 0 for normal scheduling.

    Raises:
        ParameterError: a value is refused.
    """
    chosen = {STAGE: {}, **{node: dict(section) for node, section in values.items()}}
    for node in NODE_PARAMETERS:
        chosen.setdefault(node, {})["realtime.priority"] = priority
    chosen["driver"] |= {
        "simulated.command_timeout": _DRIVER_TIMEOUT_S,
        "realtime.keep_awake": priority > 0,
    }
    # What is measured is time; at some rates no gains hold the platform.
    chosen["controller"]["control.margins"] = "warn"
    stroke_s = 0.5 * (_SETTLE_S + seconds + _REST_S - _PAUSE_S)
    stroke, acceleration = min(STROKE, 0.2 * stroke_s), 1.0
    # A trapezoidal motion takes stroke/speed + speed/acceleration.
    speed = 0.5 * acceleration * (stroke_s - math.sqrt(stroke_s**2 - 4.0 * stroke / acceleration))
    chosen[STAGE] |= {
        "rate": rate,
        "motion.start": 0.0,
        "motion.stroke": stroke,
        "motion.speed": speed,
        "motion.acceleration": acceleration,
        "motion.settle": 0.0,
        "motion.pause": _PAUSE_S,
    }
    for node in NODE_PARAMETERS:
        node_parameters(node, chosen)
    return chosen


_CELL: Mapping[str, Sequence[str]] = {"cell": [sys.executable, "-m", f"{PACKAGE}.bench.steady_cell"]}


def view_beside(priority: int) -> dict[str, Sequence[str]]:
    """Commands of the live view and of a client that reads its page, to run beside the graph.

    Args:
        priority: SCHED_FIFO priority of the graph's nodes, which the view needs too.
    """
    port = str(free_port())
    return {
        "view": verb_command("view", "--port", port, "--priority", str(priority)),
        "page": [sys.executable, "-m", f"{PACKAGE}.bench.page_reader", port],
    }


def measure(
    values: Mapping[str, Mapping[str, Any]],
    folder: Path,
    seconds: float,
    *,
    progress: Callable[[float], None] = lambda fraction: None,
    beside: Mapping[str, Sequence[str]] | None = None,
    look_interval: float = 10.0,
) -> Measurement:
    """Run the graph once and measure it.

    Args:
        values: from :func:`bench_parameters`, for the same ``seconds``.
        folder: gets bag, logs and parameter file; must not hold a bag.
        seconds: length of the window.
        progress: called with the finished fraction of the stage's motion.
        beside: further programs to run during the measurement, by name.
        look_interval: time between two looks at the nodes' memory, s.

    Raises:
        BenchFailed: a node died or the bag cannot be read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    bag, parameter_file = folder / "bag", folder / "parameters.yaml"
    parameter_file.write_text(as_parameter_file(values))
    duration = forward_and_back(node_parameters("cell", values).stage.motion)[-1].time_ns * 1e-9
    process_ids: dict[str, int] = {}
    window = Window(lambda: usage(process_ids), settle=_SETTLE_S, seconds=seconds, interval=look_interval)

    finished: list[float] = []

    def follow(fraction: float) -> bool:
        now = time.monotonic()
        window(now)
        progress(fraction)
        if window.finished:
            finished.append(now)
        # By then the window's last samples are answered and recorded.
        return bool(finished) and now >= finished[0] + _REST_S

    try:
        run_cycle(
            bag,
            parameter_file,
            folder / "logs",
            duration,
            follow,
            started=process_ids.update,
            commands=_CELL,
            programs=beside,
        )
        begin, end = window.looks[0], window.looks[-1]
        recording = read_window(bag, node_parameters("driver", values).stage.rate, begin.time_ns, end.time_ns)
        reports = read_reports(bag)
    except (LaunchError, BagError, OSError) as error:
        raise BenchFailed(str(error)) from error
    return Measurement(
        timing={node: summarise(reports.get(node, []), begin.time_ns, end.time_ns) for node in RECORDED},
        cpu_cores=cores(begin, end),
        rss_mb={node: (begin.rss_mb[node], end.rss_mb[node]) for node in RECORDED},
        growth_mb_per_hour=growth_mb_per_hour(window.looks),
        recording=recording,
        seconds=(end.time_ns - begin.time_ns) * 1e-9,
    )
