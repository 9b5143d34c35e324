"""Measures the running graph: rate, lateness, CPU, memory of each node; latency and losses of the whole, by its bag."""

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.evaluation import percentile_us, samples_taken
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.recorded_nodes import read_reports
from straightcomp_ros.cell.demonstration import free_port
from straightcomp_ros.cell.launcher import COMPOSED, RECORDED, LaunchError, program, run_cycle, verb_command
from straightcomp_ros.contract import COMMAND, DRIVER_STATE, ENCODER, STREAMS
from straightcomp_ros.model.motion import forward_and_back
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, STAGE, changed, node_parameters
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import load_map
from straightcomp_ros.timing.node_timing import summarise
from straightcomp_ros.timing.realtime import place

_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")
_UTIME = 11
"""Index of the user time after the command's name in /proc/PID/stat (proc(5): field 14); the system time follows."""


class Usage(NamedTuple):
    """What processes have used up to one moment, by name."""

    time_ns: int  # since the epoch
    cpu: Mapping[str, float]  # seconds of CPU since the start of each, all threads; known to 10 ms
    rss_mb: Mapping[str, float]  # resident memory in MB (10⁶ bytes)


def usage(process_ids: Mapping[str, int]) -> Usage:
    """Look now; OSError if a process has ended."""
    cpu, rss = {}, {}
    for name, pid in process_ids.items():
        # The command's name is in parentheses and may contain any character.
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        cpu[name] = (int(fields[_UTIME]) + int(fields[_UTIME + 1])) / _TICKS
        rss[name] = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE * 1e-6
    return Usage(time.time_ns(), cpu, rss)


def cores(begin: Usage, end: Usage) -> dict[str, float]:
    """CPU cores that each process kept busy between two looks."""
    seconds = (end.time_ns - begin.time_ns) * 1e-9
    return {name: (end.cpu[name] - begin.cpu[name]) / seconds for name in begin.cpu}


_PERCENTS = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


def read_window(bag: Path, begin_ns: int, end_ns: int) -> dict[str, Any]:
    """What a bag of the graph's logger has of the samples with stamps in [begin_ns, end_ns).

    ``lost_samples`` have no command, wherever they were lost: before the law, after it, or by the logger.
    ``latency_us`` has percentiles of the time from each sample to its command's arrival at the driver; NaN without any.
    Of ``bag``, ``expected_samples`` are those that the sampling clock took, ``missing`` the number of these without a
    message by topic, and ``amplifier_on`` the fraction of the recorded ones with the amplifier on. BagError if the bag
    cannot be read or has fewer than two samples in the window.
    """
    streams = read_streams(bag, {stream.topic: stream.layout for stream in STREAMS})

    def inside(topic: str) -> NDArray[np.bool_]:
        stamp = streams[topic].stamp
        return np.asarray((stamp >= begin_ns) & (stamp < end_ns))

    if ENCODER.topic not in streams or inside(ENCODER.topic).sum() < 2:
        raise BagError(f"bag {bag}: has no messages on '{ENCODER.topic}' in the window that was measured")
    sampled = np.unique(streams[ENCODER.topic].stamp[inside(ENCODER.topic)])
    # Losses at an edge of the window count too; a board's period is its own.
    period_ns = int(np.median(np.diff(sampled)))
    expected = samples_taken(sampled) + int(
        (sampled[0] - begin_ns) // period_ns + (end_ns - 1 - sampled[-1]) // period_ns
    )
    found = {topic: len(np.unique(stream.stamp[inside(topic)])) for topic, stream in streams.items()}
    missing = {stream.topic: expected - found.get(stream.topic, 0) for stream in STREAMS}
    latency = enabled = np.empty(0)
    if DRIVER_STATE.topic in streams:
        columns, wanted = streams[DRIVER_STATE.topic].columns, inside(DRIVER_STATE.topic)
        latency, enabled = columns["command_latency"][wanted], columns["enabled"][wanted]
        latency = latency[np.isfinite(latency)]
    return {
        "lost_samples": missing[COMMAND.topic],
        "latency_us": {name: percentile_us(latency, percent) for name, percent in _PERCENTS.items()},
        "bag": {
            "complete": not any(missing.values()),
            "expected_samples": expected,
            "missing": missing,
            "amplifier_on": float(enabled.mean()) if len(enabled) else float("nan"),
        },
    }


_SETTLE_S = 1.5
"""Motion before the window, in which caches fill and loops lock to each other."""
_REST_S = 1.0
"""Time after the window in which its last samples are answered and recorded."""
_PAUSE_S = 0.5
_AGAIN_S = 0.2
_FORGIVING = {
    "simulated.command_timeout": 1.0,
    "watch.y_limit": 0.1,
    "watch.frozen_current": 100.0,
}
"""Of a simulated machine: a stall must be measured, not switch the amplifier off, and at some rates no law holds the
platform."""
_PATIENT = {"recoveries": 1_000_000, "sample_timeout": 60.0, "heartbeat_timeout": 60.0}
"""Of the cell: it goes on whatever happens to the amplifier, so that an overloaded graph is measured too."""


class BenchFailed(RuntimeError):
    """The measurement failed; the message names the node and the reason."""


def bench_parameters(
    values: Mapping[str, Mapping[str, Any]], *, rate: int | None, seconds: float, priority: int
) -> dict[str, dict[str, Any]]:
    """Parameters of a measured run, made from ``values`` by node and dotted name; ParameterError if one is refused.

    The stage moves a little longer than the ``seconds`` of the window, from the start of its survey to its end or as
    far as it gets at 0.2 m/s; it is sampled at ``rate`` in Hz, None for its own. All nodes get this SCHED_FIFO
    ``priority``, with other programs kept off the loop's CPU, as shipped; 0 for normal scheduling. The CPUs are kept
    awake. Each node has its place on the CPUs, unless ``values`` have another. SurveyError if the survey is refused.
    """
    chosen = {node: dict(section) for node, section in values.items()}
    for node in NODE_PARAMETERS:
        chosen[node] = {"realtime.cpus": place(node), **chosen.get(node, {}), "realtime.priority": priority}
    driver = chosen["driver"]
    driver["realtime.keep_awake"], driver["realtime.exclusive"] = True, priority > 0
    if driver.get("hardware", "simulated") == "simulated":
        driver |= _FORGIVING
    chosen["cell"] |= _PATIENT
    # What is measured is time; at some rates no gains hold the platform.
    chosen["controller"]["control.margins"] = "warn"
    stroke_s = 0.5 * (_SETTLE_S + seconds + _REST_S - _PAUSE_S)
    stage: StageParameters = node_parameters("feedforward", chosen).stage
    begin, end = load_map(stage.guide).span
    stroke, acceleration = min(end - begin, min(0.2, 0.5 * stage.motion.highest_speed) * stroke_s), 1.0
    # A trapezoidal motion takes stroke/speed + speed/acceleration.
    speed = 0.5 * acceleration * (stroke_s - math.sqrt(stroke_s**2 - 4.0 * stroke / acceleration))
    motion = {
        "rate": stage.rate if rate is None else rate,
        "motion.start": begin,
        "motion.stroke": stroke,
        "motion.steps": 1,
        "motion.file": "",
        "motion.speed": speed,
        "motion.acceleration": acceleration,
        "motion.settle": 0.0,
        "motion.jerk": 0.0,
        "motion.pause": _PAUSE_S,
    }
    chosen = changed(chosen, {STAGE: motion})
    for node in NODE_PARAMETERS:
        node_parameters(node, chosen)
    return chosen


_NODE_OF = {COMPOSED: "driver"}
"""The node whose figures are those of a process with several."""


def view_programs(priority: int) -> dict[str, Sequence[str]]:
    """Commands of the live view, with the graph's ``priority``, and of a client that reads its page."""
    port = str(free_port())
    return {
        "view": verb_command("view", "--port", port, "--priority", str(priority)),
        "page": program(f"from {__name__} import read_page; read_page({port})"),
    }


def read_page(port: int) -> None:
    """Read a view's events like an open page until interrupted; reconnect like a browser whenever it is not there."""
    with suppress(KeyboardInterrupt):
        while True:
            connection = HTTPConnection("127.0.0.1", port, timeout=10.0)
            with closing(connection), suppress(OSError, HTTPException):
                connection.request("GET", "/news")
                answer = connection.getresponse()
                while answer.readline():
                    pass
            time.sleep(_AGAIN_S)


def measure(
    values: Mapping[str, Mapping[str, Any]],
    folder: Path,
    seconds: float,
    *,
    progress: Callable[[float], None],
    programs: Mapping[str, Sequence[str]] | None = None,
    composed: bool = False,
) -> dict[str, Any]:
    """Run the graph once with the parameters of :func:`bench_parameters` for the same ``seconds``, and measure it.

    Bag, logs and parameter file go to ``folder``, which must not hold a bag. ``progress`` is called with the finished
    fraction of the stage's motion; ``programs`` are further ones to run, by name. Returns the figures by name as
    `straightcomp bench graph --json` prints them; BenchFailed if a node died or the bag cannot be read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    bag, parameter_file = folder / "bag", folder / "parameters.yaml"
    parameter_file.write_text(as_parameter_file(values))
    duration = forward_and_back(node_parameters("cell", values).stage.motion)[-1].time_ns * 1e-9
    process_ids: dict[str, int] = {}
    looks, due = list[Usage](), list[float]()

    def follow(fraction: float) -> bool:
        """Look at both ends of the window; the cycle may end when the window's last samples are recorded."""
        now = time.monotonic()
        if not due:
            due.extend(now + after for after in (_SETTLE_S, _SETTLE_S + seconds, _SETTLE_S + seconds + _REST_S))
        if len(looks) < 2 and now >= due[len(looks)]:
            looks.append(usage(process_ids))
        progress(fraction)
        return now >= due[-1]

    try:
        run_cycle(
            bag,
            parameter_file,
            folder / "logs",
            duration,
            follow,
            started=lambda ids: process_ids.update({_NODE_OF.get(name, name): pid for name, pid in ids.items()}),
            programs=programs,
            composed=composed,
        )
        begin, end = looks
        recording = read_window(bag, begin.time_ns, end.time_ns)
        reports = read_reports(bag)
    except (LaunchError, BagError, OSError) as error:
        raise BenchFailed(str(error)) from error
    timing = {node: summarise(reports.get(node, []), begin.time_ns, end.time_ns) for node in RECORDED}
    cpu_cores, figures = cores(begin, end), dict[str, Any]()
    for node, one in timing.items():
        shown = one.to_display()
        figures[node] = {key: shown[key] for key in ("rate_hz", "overruns", "stalls", "timer_error_us")}
        figures[node] |= {"cpu_cores": cpu_cores.get(node), "rss_mb": [one.rss_mb.get(node) for one in (begin, end)]}
    return {
        **figures,
        **recording,
        "overruns": sum(one.overruns for one in timing.values()),
        "stalls": sum(one.stalls for one in timing.values()),
        "cpu_cores": sum(cpu_cores.values()),
        "seconds": (end.time_ns - begin.time_ns) * 1e-9,
    }
