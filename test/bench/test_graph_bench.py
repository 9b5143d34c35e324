"""What the graph's bench is made of, without a graph: window, processes, bag, parameters."""

import pytest
from bag_of_rows import bag_of_rows

from straightcomp_ros.bags import BagError
from straightcomp_ros.bench import graph_bench
from straightcomp_ros.bench.graph_bench import (
    BenchFailed,
    bench_parameters,
    measure,
    read_window,
)
from straightcomp_ros.cell.launcher import LaunchError
from straightcomp_ros.contract import COMMAND, CONTROLLER_STATE, DRIVER_STATE, STREAMS
from straightcomp_ros.model.motion import forward_and_back, reach
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters

START = 1_700_000_000_000_000_000
PERIOD = 500_000


def test_the_window_begins_after_the_settling_and_ends_once(monkeypatch, tmp_path):
    now, seen = [100.0], []

    def cycle(bag, parameters, logs, duration, follow, **_):
        while not follow(0.5):
            now[0] += 0.05
        raise LaunchError("over")

    monkeypatch.setattr(graph_bench, "run_cycle", cycle)
    monkeypatch.setattr(graph_bench, "usage", lambda ids: seen.append(now[0]))
    monkeypatch.setattr(graph_bench.time, "monotonic", lambda: now[0])
    values = bench_parameters(shipped_parameters(), rate=None, seconds=25.0, priority=0)
    with pytest.raises(BenchFailed, match="over"):
        measure(values, tmp_path, 25.0, progress=lambda fraction: None)
    assert seen == pytest.approx([101.5, 126.5], abs=0.06)
    assert now[0] == pytest.approx(seen[-1] + 1.0, abs=0.06)


def sample(number, period=PERIOD):
    """A row of each stream; the amplifier is on from sample 300 on."""
    for stream in STREAMS:
        state = (number * 1e-6, 0.0, 0.0, float(number >= 300))
        yield stream, START + number * period, state if stream is DRIVER_STATE else [0.0] * len(stream.layout.columns)


def test_every_sample_of_the_window_is_asked_for_on_every_topic_and_its_edges_count(tmp_path):
    # Every 10th sample lacks its command, and the last of the window the controller's state.
    left_out = {COMMAND: range(0, 1000, 10), CONTROLLER_STATE: [899]}
    rows = (row for k in range(1000) for row in sample(k) if k not in left_out.get(row[0], ()))
    bag = bag_of_rows(tmp_path / "bag", rows)
    found = read_window(bag, START + 100 * PERIOD, START + 900 * PERIOD)
    missing = {"encoder": 0, "reference": 0, "command": 80, "controller_state": 1, "driver_state": 0, "truth": 0}
    expected = {"expected_samples": 800, "missing": missing, "complete": False, "amplifier_on": pytest.approx(0.75)}
    assert found["bag"] == expected and found["lost_samples"] == 80
    assert found["latency_us"] == pytest.approx({"p50": 499.5, "p99": 891.01, "p999": 898.201, "max": 899})
    beyond = read_window(bag, START - 50 * PERIOD, START + 1010 * PERIOD)["bag"]
    assert beyond["expected_samples"] == 1060 and beyond["missing"]["encoder"] == 60
    with pytest.raises(BagError, match="window"):
        read_window(bag, START + 10**12, START + 2 * 10**12)


def test_a_board_with_a_clock_of_its_own_loses_nothing_by_that(tmp_path):
    period = PERIOD + PERIOD // 200
    bag = bag_of_rows(tmp_path / "bag", (row for k in range(1000) for row in sample(k, period)))
    found = read_window(bag, START, START + 1000 * period)["bag"]
    assert (found["expected_samples"], found["complete"]) == (1000, True)


@pytest.mark.parametrize(
    ("rate", "seconds", "priority", "facts"),
    [
        (1000, 2.0, 0, {}),
        (2000, 20.0, 30, {}),
        (4000, 3600.0, 0, {}),
        (None, 20.0, 0, {}),
        (None, 20.0, 0, {"motion.speed": 0.05, "motion.highest_speed": 0.1}),
        (None, 2.0, 0, {"motion.speed": 0.05, "motion.highest_speed": 0.1}),
    ],
)
def test_at_every_rate_the_stage_moves_all_the_while_and_all_nodes_have_the_priority(rate, seconds, priority, facts):
    given = shipped_parameters()
    given["stage"] |= facts
    values = bench_parameters(given, rate=rate, seconds=seconds, priority=priority)
    controller, driver, cell = (node_parameters(node, values) for node in ("controller", "driver", "cell"))
    assert controller.stage.rate == driver.stage.rate == (rate or 2000)
    duration = forward_and_back(cell.stage.motion)[-1].time_ns * 1e-9
    assert duration == pytest.approx(seconds + 2.5)
    assert {values[node]["realtime.priority"] for node in NODE_PARAMETERS} == {priority}
    assert driver.realtime.keep_awake and driver.realtime.exclusive is (priority > 0)


@pytest.mark.parametrize(("rate", "measured_at"), [(None, 1000), (4000, 4000)])
def test_the_graph_is_measured_at_the_stages_rate_and_over_its_survey_unless_another_rate_is_asked_for(
    tmp_path, rate, measured_at
):
    (tmp_path / "survey.csv").write_text(
        "x_mm,deviation_um\n" + "".join(f"{x},{x * x / 1e4}\n" for x in range(-100, 201, 10))
    )
    (tmp_path / "positions.txt").write_text("0.05\n0.1\n")
    facts = {"rate": 1000, "guide.file": "survey.csv", "motion.file": "positions.txt", "motion.start": 0.05}
    (tmp_path / "stage.yaml").write_text(f"/**: {{ros__parameters: {{stage: {facts}}}}}")
    given = shipped_parameters(stage=tmp_path / "stage.yaml")
    # Of one node's own section.
    given["driver"]["stage.rate"] = 1000
    values = bench_parameters(given, rate=rate, seconds=20.0, priority=0)
    for node in ("driver", "feedforward", "controller", "cell"):
        stage = node_parameters(node, values).stage
        assert stage.rate == measured_at and reach(stage.motion) == pytest.approx((-0.1, 0.2)), node
    assert stage.motion.start == pytest.approx(-0.1)
    assert forward_and_back(stage.motion)[-1].time_ns * 1e-9 == pytest.approx(22.5)
