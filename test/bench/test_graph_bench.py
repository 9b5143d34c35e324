"""What the graph's bench is made of, without a graph: window, processes, bag, parameters."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.bench.graph_bench import bench_parameters
from straightcomp_ros.bench.processes import Usage, cores, usage
from straightcomp_ros.bench.recorded_window import read_window
from straightcomp_ros.bench.window import Window, growth_mb_per_hour
from straightcomp_ros.contract import DRIVER_STATE, STREAMS
from straightcomp_ros.model.motion import forward_and_back
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters

START = 1_700_000_000_000_000_000
PERIOD = 500_000


def test_the_window_begins_after_the_settling_and_ends_once():
    taken = []
    window = Window(lambda: taken.append(None), settle=1.0, seconds=25.0)
    times = np.arange(100.0, 140.0, 0.05)
    seen = []
    for now in times:
        before = len(taken)
        window(now)
        if len(taken) > before:
            seen.append(now)
    np.testing.assert_allclose(seen, [101.0, 111.0, 121.0, 126.0], atol=0.06)
    assert window.finished


def test_the_slope_of_the_memory_is_that_of_the_line_through_the_looks():
    noise = (0.3, -0.3, -0.3, 0.3)
    looks = [Usage(START + k * 10 * 10**9, {}, {"a": 50.0 + 0.2 * k + noise[k], "b": 7.0}) for k in range(4)]
    slope = growth_mb_per_hour(looks)
    assert slope["a"] == pytest.approx(0.2 / 10 * 3600) and slope["b"] == pytest.approx(0.0, abs=1e-9)
    assert math.isnan(growth_mb_per_hour(looks[:1])["a"])


def test_cpu_and_memory_of_a_process_are_its_own():
    code = "import time\nblock = bytearray(b'x' * 60_000_000)\nprint(flush=True)\nend = time.process_time() + 0.5\n"
    code += "while time.process_time() < end: pass\nprint(flush=True)\ntime.sleep(60)\n"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    try:
        process.stdout.readline()
        begin = usage({"busy": process.pid, "here": os.getpid()})
        process.stdout.readline()
        end = usage({"busy": process.pid, "here": os.getpid()})
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    seconds = (end.time_ns - begin.time_ns) * 1e-9
    assert cores(begin, end)["busy"] * seconds == pytest.approx(0.5, abs=0.1)
    assert cores(begin, end)["here"] * seconds < 0.3
    assert 60 < end.rss_mb["busy"] < 120
    with pytest.raises(OSError):
        usage({"busy": process.pid})


@pytest.fixture
def bag(tmp_path):
    """1000 samples; every 10th lacks its command, the controller's state lacks the last of the first 900."""
    with BagWriter(tmp_path / "bag") as bag:
        for stream in STREAMS:
            bag.add_topic(f"/{stream.topic}", stream.layout.type_name)
        for k in range(1000):
            stamp = START + k * PERIOD
            for stream in STREAMS:
                if (stream.topic == "command" and k % 10 == 0) or (stream.topic == "controller_state" and k == 899):
                    continue
                numbers = [0.0] * len(stream.layout.columns)
                if stream is DRIVER_STATE:
                    numbers = [k * 1e-6, 0.0, 0.0, float(k >= 300)]
                bag.write(f"/{stream.topic}", stream.layout.pack(stamp, *numbers), stamp, stamp)
    return tmp_path / "bag"


def test_every_sample_of_the_window_is_asked_for_on_every_topic(bag):
    found = read_window(bag, 2000, START + 100 * PERIOD, START + 900 * PERIOD)
    assert found.expected == 800
    missing = {"encoder": 0, "reference": 0, "command": 80, "controller_state": 1, "driver_state": 0, "truth": 0}
    assert found.missing == missing and found.lost_samples == 80
    assert found.amplifier_on == pytest.approx(0.75)
    assert found.latency_us()["max"] == pytest.approx(899) and found.latency_us()["p50"] == pytest.approx(499.5)


def test_samples_lost_at_the_edges_of_the_window_count(bag):
    found = read_window(bag, 2000, START - 50 * PERIOD, START + 1010 * PERIOD)
    assert found.expected == 1060 and found.missing["encoder"] == 60


def test_a_window_without_samples_is_an_error(bag):
    with pytest.raises(BagError, match="window"):
        read_window(bag, 2000, START + 10**12, START + 2 * 10**12)


@pytest.mark.parametrize("rate", [1000, 2000, 4000])
@pytest.mark.parametrize("seconds", [2.0, 20.0, 3600.0])
def test_at_every_rate_the_stage_moves_all_the_while(rate, seconds):
    shipped = shipped_parameters()
    values = bench_parameters(shipped, rate=rate, seconds=seconds, priority=0)
    controller, driver, cell = (node_parameters(node, values) for node in ("controller", "driver", "cell"))
    assert controller.stage.rate == driver.stage.rate == rate
    duration = forward_and_back(cell.stage.motion)[-1].time_ns * 1e-9
    assert duration == pytest.approx(seconds + 2.5)
    assert all(values[node]["realtime.priority"] == 0 for node in NODE_PARAMETERS)
    assert not driver.realtime.keep_awake


def test_a_priority_is_that_of_all_nodes_and_is_checked():
    shipped = shipped_parameters()
    values = bench_parameters(shipped, rate=2000, seconds=5.0, priority=30)
    assert {values[node]["realtime.priority"] for node in NODE_PARAMETERS} == {30}
    assert values["driver"]["realtime.keep_awake"] is True
    with pytest.raises(ParameterError, match=r"realtime\.priority"):
        bench_parameters(shipped, rate=2000, seconds=5.0, priority=99)
    with pytest.raises(ParameterError, match=r"stage\.rate"):
        bench_parameters(shipped, rate=1, seconds=5.0, priority=0)
