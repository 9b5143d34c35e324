"""Measure the cost of reading and evaluating a bag. Every number is measured in this call.

`read` {ours_us, rosbags_us, rosbags_ratio, equal} compares the CPU time of our streams as columns with that of all
messages of the same topics decoded by rosbags."""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.topics import typestore
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.contract import STREAMS
from straightcomp_ros.messages.cdr import read_by_names
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from trials.rig import simulated

SUMMARY = "reading and evaluating bags"
_LAYOUTS = {stream.topic: stream.layout for stream in STREAMS}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--bag", metavar="BAG", type=Path, help="a recorded stroke (default: a full stroke is simulated)"
    )


def run(options: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory() as folder:
        bag = options.bag or simulated(Path(folder) / "run", shipped_parameters())
        print_json({"read": reading(bag), "evaluate_s": _evaluating(bag)})


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
