"""`straightcomp bench` as it is typed."""

import math

import pytest

from straightcomp_ros.bench.step_costs import cost
from straightcomp_ros.cli.bench import medians, ratios
from straightcomp_ros.contract import STREAMS
from straightcomp_ros.control.laws import LAWS

SHORT = ["--set", "stage.motion.stroke=0.05", "--set", "stage.motion.settle=0.1"]


def test_each_law_each_stream_and_the_simulation_are_timed_and_in_the_table(verb):
    figures = verb("bench", "step", "--json", "--repeats", "3", *SHORT).json
    assert list(figures["laws"]) == list(LAWS)
    assert list(figures["messages"]) == [stream.topic for stream in STREAMS]
    simulate = figures["simulate"]
    found = [*figures["laws"].values(), *(verb for both in figures["messages"].values() for verb in both.values())]
    for values in [*found, simulate["sample"]]:
        assert 0 < values["min_us"] <= values["median_us"] <= values["max_us"]
    # One simulated sample is half a millisecond.
    assert simulate["simulated_seconds_per_second"] * simulate["sample"]["median_us"] == pytest.approx(500.0)
    printed = verb("bench", "step", "--repeats", "1", *SHORT).out
    assert all(law in printed for law in LAWS) and all(f"unpack '{stream.topic}'" in printed for stream in STREAMS)


def test_the_cost_of_a_call_is_that_of_all_divided_by_their_number(monkeypatch):
    monkeypatch.setattr("timeit.repeat", lambda work, number, repeat: [2e-5, 1e-5, 6e-5])
    assert cost(lambda: None, 10, 3) == pytest.approx({"min_us": 1.0, "median_us": 2.0, "max_us": 6.0})


def test_a_ratio_with_nothing_below_it_is_no_number():
    def figures(cpu, p99):
        return {"cpu_cores": cpu, "latency_us": {"p50": 100.0, "p99": p99, "p999": 1000.0, "max": 4000.0}}

    found = ratios(figures(1.0, 300.0), figures(2.0, 0.0))
    assert (found["cpu_cores"], found["latency_p50"]) == pytest.approx((0.5, 1.0))
    assert math.isnan(found["latency_p99"])
    middle = medians([figures(1.0, 300.0), figures(9.0, 1.0), figures(2.0, 310.0)])
    assert middle["cpu_cores"] == 2.0 and middle["latency_us"]["p99"] == 300.0
