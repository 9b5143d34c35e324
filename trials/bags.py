"""Measure the cost of recording, reading and evaluating bags, and the loss by a SIGKILL. Every number is measured in
this call; null stands for what cannot be measured here (no ROS).

`record` {lost, cpu_cores} is of the logger's process with 16,000 messages a second on 8 topics; `read` {ours_us,
rosbags_us, rosbags_ratio, equal} compares the CPU time of our streams as columns with that of all messages of the same
topics decoded by rosbags."""

import argparse
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.folder import bag_files
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.bags.topics import typestore
from straightcomp_ros.cell.launcher import Graph, ros_available
from straightcomp_ros.cli.options import check_range
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.contract import STREAMS
from straightcomp_ros.messages.cdr import read_by_names
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from trials.rig import progress, simulated
from trials.traffic import record_traffic

SUMMARY = "recording, reading, evaluation, SIGKILL"
_LAYOUTS = {stream.topic: stream.layout for stream in STREAMS}
_SOME_CHUNKS = 40_000
"""Size of a bag with some chunks, and the descriptions and parameters before them, in bytes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--bag", metavar="BAG", type=Path, help="a recorded stroke (default: a full stroke is simulated)")
    add("--kill-runs", type=int, default=20, metavar="N", help="recordings to kill (default: %(default)s)")
    add("--seconds", type=float, default=20.0, help="length of the live recording (default: %(default)s)")


def run(options: argparse.Namespace) -> None:
    check_range("--kill-runs", options.kill_runs, 0, 10_000)
    check_range("--seconds", options.seconds, 1.0, 3600.0, "s")
    if options.bag is not None:
        bag_files(options.bag)  # refused before anything is recorded
    with tempfile.TemporaryDirectory() as folder, progress() as advance:
        work = Path(folder)
        advance("simulating a stroke", 0.0)
        bag = options.bag or simulated(work / "run", shipped_parameters())
        advance("recording", 0.02)
        lost, cores = record_traffic(work, options.seconds) if ros_available() else (None, None)
        advance("reading", 0.25)
        read = reading(bag)
        advance("evaluating", 0.4)
        seconds = _evaluating(bag)
        kill = _killing(bag, work, options.kill_runs, lambda done: advance("killing recordings", 0.45 + 0.5 * done))
    record = {"lost": lost, "cpu_cores": cores}
    print_json({"record": record, "read": read, "evaluate_s": seconds, "kill": kill})


def reading(bag: Path) -> dict[str, Any]:
    """Read the streams of a bag three times, and by rosbags: CPU time, and whether all numbers are equal."""
    from rosbags.rosbag2 import Reader

    times = []
    for _ in range(3):
        started = time.process_time()
        ours = read_streams(bag, _LAYOUTS)
        times.append(time.process_time() - started)
    spent, count, store = statistics.median(times), sum(map(len, ours.values())), typestore()
    theirs: dict[str, list[tuple[int, list[float]]]] = {topic: [] for topic in ours}
    started = time.process_time()
    with Reader(bag) as reader:
        messages = [
            (connection.topic[1:], store.deserialize_cdr(data, connection.msgtype))
            for connection, _, data in reader.messages()
            if connection.topic[1:] in ours
        ]
    rosbags_spent = time.process_time() - started
    for topic, message in messages:
        theirs[topic].append(read_by_names(_LAYOUTS[topic], message))
    return {
        "ours_us": spent / count * 1e6,
        "rosbags_us": rosbags_spent / count * 1e6,
        "rosbags_ratio": rosbags_spent / spent,
        "equal": all(_same(ours[topic], rows) for topic, rows in theirs.items()),
    }


def _same(stream: Any, rows: list[tuple[int, list[float]]]) -> bool:
    numbers = np.array([row for _, row in rows], np.float64).T
    columns = np.array(list(stream.columns.values()))
    return stream.stamp.tolist() == [stamp for stamp, _ in rows] and columns.tobytes() == numbers.tobytes()


def _evaluating(bag: Path) -> float:
    """Wall time of the command, including Python's start and imports; the median of three."""
    times = []
    for _ in range(3):
        started = time.perf_counter()
        command = [sys.executable, "-m", "straightcomp_ros.cli.main", "evaluate", str(bag), "--json"]
        subprocess.run(command, check=True, capture_output=True)
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def _killing(bag: Path, work: Path, runs: int, advance: Callable[[float], object]) -> dict[str, Any]:
    """Kill recordings of the logger at random moments: longest time from the last saved message to the kill."""
    if not ros_available() or runs < 1:
        return {"runs": 0, "max_lost_s": None}
    worst = 0.0
    for number in range(runs):
        advance(number / runs)
        killed = work / f"killed{number}"
        with Graph(work / f"logs{number}") as graph:
            logger = graph.start("logger", {"output": str(killed), "nodes": "player"})
            begun = _wait_for(killed)
            graph.start("player", {"bag": str(bag.absolute()), "subscribers": 1})
            _wait_for(killed, begun + _SOME_CHUNKS)
            time.sleep(random.uniform(0.2, 1.2))
            logger.send_signal(signal.SIGKILL)
            at_ns = time.time_ns()
            logger.wait()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = recover(killed, work / f"recovered{number}")
        if result.last_ns is None:
            raise BagError(f"bag {killed}: was killed before a message was recorded; measure again")
        worst = max(worst, (at_ns - result.last_ns) * 1e-9)
    return {"runs": runs, "max_lost_s": worst}


def _wait_for(bag: Path, size: int = 1, timeout: float = 120.0) -> int:
    """Wait until the bag's file has ``size`` bytes; returns its size."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        found = max((file.stat().st_size for file in bag.glob("*.mcap")), default=0)
        if found >= size:
            return found
        time.sleep(0.05)
    raise BagError(f"bag {bag}: nothing was recorded within {timeout:g} s")
