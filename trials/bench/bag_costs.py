"""Measures bags: recording, reading, evaluation, loss by SIGKILL, audit.

Every number is measured in this call; None stands for what cannot be measured here (no ROS, a package that is missing).
"""

import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.folder import bag_files
from straightcomp_ros.bags.qos import TopicQos
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.cell.launcher import Graph, ros_available
from straightcomp_ros.contract import STREAMS
from straightcomp_ros.messages.cdr import read_by_names
from straightcomp_ros.offline.audit import audit
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from trials.bench.traffic_streams import record_traffic

_LAYOUTS = {stream.topic: stream.layout for stream in STREAMS}
_SOME_CHUNKS = 40_000
"""Size of a bag with some chunks, and the descriptions and parameters before them, in bytes."""


def run(
    bag: Path | None,
    kill_runs: int,
    record_s: float = 20.0,
    progress: Callable[[str, float], None] = lambda text, done: None,
) -> dict[str, Any]:
    """Measure everything.

    Args:
        bag: a recorded stroke; a full stroke forward and back is simulated if None.
        kill_runs: number of recordings to kill.
        record_s: length in s of the live recording, 16,000 messages a second on 8 topics.
        progress: called with the name of the next step, and the finished fraction.

    Returns:
        ``record`` {lost, cpu_cores, us_per_message, bytes_per_message}: the first two for the live recording by the
        logger's process, the others for writing ``bag`` again; ``read`` {ours_us, rosbags_us, mcap_ros2_us (CPU time in
        µs per message), rosbags_ratio, equal}: our streams as columns, compared with all messages of the same topics
        decoded by rosbags, and with the file decoded by mcap_ros2;
        ``evaluate_s``, ``kill`` {runs, max_lost_s}, ``audit`` {commands, different}.

    Raises:
        BagError: the bag cannot be used.
        LaunchError: a node could not be started.
    """
    if bag is not None:
        bag_files(bag)  # refused before anything is recorded
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        if bag is None:
            progress("simulating a stroke", 0.0)
            bag = work / "run"
            values = shipped_parameters()
            simulation = Simulation(values)
            with SimulatedRun(bag, by_node(values), simulation.delay) as recording:
                simulation.run(observe=recording.add)
        bag = Path(bag)
        progress("recording", 0.02)
        record = {**_live_recording(work, record_s), **_writing(bag, work)}
        progress("reading", 0.25)
        read = _reading(bag)
        progress("evaluating", 0.4)
        seconds = _evaluating(bag)
        kill = _killing(bag, work, kill_runs, lambda done: progress("killing recordings", 0.45 + 0.5 * done))
        progress("auditing", 0.95)
        found = audit(bag)
    return {
        "record": record,
        "read": read,
        "evaluate_s": seconds,
        "kill": kill,
        "audit": {"commands": found.commands, "different": found.different},
    }


def _writing(bag: Path, work: Path) -> dict[str, float]:
    """Write the messages of a real run again: CPU time and size of each."""
    streams = read_streams(bag, _LAYOUTS)
    messages = []
    for topic, stream in streams.items():
        pack = _LAYOUTS[topic].pack
        rows = zip(*(column.tolist() for column in stream.columns.values()), strict=True)
        messages += [
            (log_time, f"/{topic}", pack(stamp, *row))
            for log_time, stamp, row in zip(stream.log_time.tolist(), stream.stamp.tolist(), rows, strict=True)
        ]
    messages.sort(key=lambda message: message[0])
    with BagWriter(work / "written") as writer:
        for topic in streams:
            writer.add_topic(f"/{topic}", _LAYOUTS[topic].type_name, TopicQos("best_effort"))
        started = time.process_time()
        for log_time, topic, data in messages:
            writer.write(topic, data, log_time, log_time)
        writer.flush()
        spent = time.process_time() - started
        size = writer.path.stat().st_size
    return {"us_per_message": spent / len(messages) * 1e6, "bytes_per_message": size / len(messages)}


def _live_recording(work: Path, seconds: float) -> dict[str, float | None]:
    """Load the logger fully: number of messages missing in its bag, and CPU cores that the node used."""
    if not ros_available():
        return {"lost": None, "cpu_cores": None}
    missing, busy = record_traffic(work, seconds)
    return {"lost": missing, "cpu_cores": busy}


def _wait_for(bag: Path, size: int = 1, timeout: float = 120.0) -> int:
    """Wait until the bag's file has ``size`` bytes; returns its size."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        found = max((file.stat().st_size for file in bag.glob("*.mcap")), default=0)
        if found >= size:
            return found
        time.sleep(0.05)
    raise BagError(f"bag {bag}: nothing was recorded within {timeout:g} s")


def _reading(bag: Path) -> dict[str, Any]:
    from rosbags.rosbag2 import Reader

    times = []
    for _ in range(3):
        started = time.process_time()
        ours = read_streams(bag, _LAYOUTS)
        times.append(time.process_time() - started)
    spent = statistics.median(times)
    count = sum(map(len, ours.values()))

    from straightcomp_ros.bags.definitions import typestore

    store = typestore()
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
    equal = all(_same(ours[topic], rows) for topic, rows in theirs.items())
    return {
        "ours_us": spent / count * 1e6,
        "rosbags_us": rosbags_spent / count * 1e6,
        "rosbags_ratio": rosbags_spent / spent,
        "mcap_ros2_us": _mcap_ros2_us(bag),
        "equal": equal,
    }


def _same(stream: Any, rows: list[tuple[int, list[float]]]) -> bool:
    numbers = np.array([row for _, row in rows], np.float64).T
    columns = np.array(list(stream.columns.values()))
    return stream.stamp.tolist() == [stamp for stamp, _ in rows] and columns.tobytes() == numbers.tobytes()


def _mcap_ros2_us(bag: Path) -> float | None:
    try:
        from mcap_ros2.reader import read_ros2_messages
    except ImportError:
        return None
    file = next(iter(sorted(bag.glob("*.mcap"))), bag)
    started = time.process_time()
    count = sum(1 for _ in read_ros2_messages(file))
    return (time.process_time() - started) / count * 1e6


def _evaluating(bag: Path) -> float:
    """Wall time of the command, including Python's start and imports; the median of three."""
    times = []
    for _ in range(3):
        started = time.perf_counter()
        command = [sys.executable, "-m", "straightcomp_ros.cli.main", "evaluate", str(bag), "--json"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def _killing(bag: Path, work: Path, runs: int, progress: Callable[[float], None]) -> dict[str, Any]:
    """Kill recordings of the logger at random moments: longest time from the last saved message to the kill."""
    if not ros_available() or runs < 1:
        return {"runs": 0, "max_lost_s": None}
    worst = 0.0
    for number in range(runs):
        progress(number / runs)
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


def flattened(figures: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of :func:`run` as one level of dotted names."""
    flat: dict[str, Any] = {}
    for name, value in figures.items():
        flat.update(
            {f"{name}.{key}": one for key, one in value.items()} if isinstance(value, Mapping) else {name: value}
        )
    return flat
