"""The bench of the running graph with either trigger of the controller: figures that belong to what ran."""

import json

import pytest

from straightcomp_ros.cli.main import main

pytestmark = [pytest.mark.live, pytest.mark.keeps_time, pytest.mark.nightly]

NODES = ("driver", "feedforward", "controller", "logger")


def test_both_triggers_are_measured_in_one_run_and_only_json_is_printed(capfd, tmp_path):
    arguments = ["--rate", "100", "--soak", "0.07", "--triggers", "--json", "--output", str(tmp_path)]
    assert main(["bench", "graph", *arguments]) == 0
    figures = json.loads(capfd.readouterr().out)
    assert figures["trigger"] == "sample"
    timer = figures["timer"]
    assert figures["soak"]["growth_mb_per_hour"].keys() == set(NODES)
    for measured in (figures, timer):
        assert measured["seconds"] == pytest.approx(4.2, abs=2.0)
        assert measured["bag"]["expected_samples"] == pytest.approx(100 * measured["seconds"], abs=2)
        for node in NODES:
            # It reports once a second. None means that it fell silent.
            assert measured[node]["rate_hz"] is not None, f"{node} reported less than twice in the window"
            # None handles more than there is, but for a backlog.
            assert 0 < measured[node]["rate_hz"] < 200
            assert 0 < measured[node]["cpu_cores"] < 2 and min(measured[node]["rss_mb"]) > 10
            late = measured[node]["timer_error_us"]
            assert 0 <= late["p50"] <= late["p99"] <= late["p999"] <= late["max"]
        assert measured["cpu_cores"] == pytest.approx(sum(measured[node]["cpu_cores"] for node in NODES))
        assert measured["lost_samples"] == measured["bag"]["missing"]["command"] <= measured["bag"]["expected_samples"]
        latency = measured["latency_us"]
        assert 0 < latency["p50"] <= latency["p99"] <= latency["p999"] <= latency["max"]
    assert figures["ratio"]["cpu_cores"] == pytest.approx(figures["cpu_cores"] / timer["cpu_cores"])
    assert figures["ratio"]["latency_p50"] == pytest.approx(figures["latency_us"]["p50"] / timer["latency_us"]["p50"])
    # Both really recorded, and each its own.
    assert all((tmp_path / graph / "bag" / "metadata.yaml").exists() for graph in ("graph", "timer"))
    assert main(["bench", "graph", *arguments]) == 2
    assert str(tmp_path) in capfd.readouterr().err
