"""The bench of the running graph, and of the plain one beside it: figures that belong to what ran."""

import json

import pytest

from straightcomp_ros.cli.main import main

pytestmark = [pytest.mark.live, pytest.mark.keeps_time]

NODES = ("driver", "feedforward", "controller", "logger")


def test_both_graphs_are_measured_in_one_run_and_only_json_is_printed(capfd, tmp_path):
    arguments = ["--rate", "100", "--soak", "0.07", "--baseline", "--json", "--output", str(tmp_path)]
    assert main(["bench", "graph", *arguments]) == 0
    figures = json.loads(capfd.readouterr().out)
    baseline = figures["baseline"]
    assert figures["soak"]["growth_mb_per_hour"].keys() == set(NODES)
    for measured in (figures, baseline):
        assert measured["seconds"] == pytest.approx(4.2, abs=2.0)
        assert measured["bag"]["expected_samples"] == pytest.approx(100 * measured["seconds"], abs=2)
        for node in NODES:
            # It reports once a second. None means that it fell silent: the executor's timers did so after a slow start.
            assert measured[node]["rate_hz"] is not None, f"{node} reported less than twice in the window"
            # None handles more than there is, but for a backlog.
            assert 0 < measured[node]["rate_hz"] < 200
            assert 0 < measured[node]["cpu_cores"] < 2 and min(measured[node]["rss_mb"]) > 10
        assert measured["cpu_cores"] == pytest.approx(sum(measured[node]["cpu_cores"] for node in NODES))
        assert measured["lost_samples"] == measured["bag"]["missing"]["command"] <= measured["bag"]["expected_samples"]
        latency = measured["latency_us"]
        assert 0 < latency["p50"] <= latency["p99"] <= latency["p999"] <= latency["max"]
    for node in NODES:
        late = figures[node]["timer_error_us"]
        assert 0 <= late["p50"] <= late["p99"] <= late["p999"] <= late["max"]
        assert baseline[node]["timer_error_us"]["p50"] is None
    assert figures["ratio"]["cpu_cores"] == pytest.approx(figures["cpu_cores"] / baseline["cpu_cores"])
    # Both really recorded, and each its own.
    assert all((tmp_path / graph / "bag" / "metadata.yaml").exists() for graph in ("graph", "baseline"))
    assert main(["bench", "graph", *arguments]) == 2
    assert "holds a bag" in capfd.readouterr().err
