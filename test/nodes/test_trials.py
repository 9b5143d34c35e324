"""Test rigs of `trials/` in real processes: the bench of the graph, a short soak run."""

import json
import subprocess
import sys

import pytest

from straightcomp_ros.cell.launcher import RECORDED
from straightcomp_ros.cli.main import main
from trials.soak import ACTIONS

pytestmark = [pytest.mark.keeps_time, pytest.mark.nightly]


@pytest.mark.live
def test_two_values_of_a_parameter_are_measured_in_turns_and_only_json_is_printed(capfd, tmp_path):
    arguments = ["--rate", "100", "--seconds", "4.2", "--against", "controller.trigger=timer", "--json"]
    arguments += ["--output", str(tmp_path)]
    assert main(["bench", "graph", *arguments]) == 0
    figures = json.loads(capfd.readouterr().out)
    timer = figures["against"]
    for measured in (figures, timer):
        assert measured["seconds"] == pytest.approx(4.2, abs=2.0)
        assert measured["bag"]["expected_samples"] == pytest.approx(100 * measured["seconds"], abs=2)
        for node in RECORDED:
            # It reports once a second. None means that it fell silent.
            assert measured[node]["rate_hz"] is not None, f"{node} reported less than twice in the window"
            # None handles more than there is, but for a backlog.
            assert 0 < measured[node]["rate_hz"] < 200
            assert 0 < measured[node]["cpu_cores"] < 2 and min(measured[node]["rss_mb"]) > 10
            late = measured[node]["timer_error_us"]
            assert 0 <= late["p50"] <= late["p99"] <= late["p999"] <= late["max"]
        assert measured["cpu_cores"] == pytest.approx(sum(measured[node]["cpu_cores"] for node in RECORDED))
        assert measured["latency_us"]["p50"] > 0
    assert figures["against_ratio"]["cpu_cores"] == pytest.approx(timer["cpu_cores"] / figures["cpu_cores"])
    # Both really recorded, and each its own.
    assert all((tmp_path / graph / "bag" / "metadata.yaml").exists() for graph in ("graph", "against"))
    assert main(["bench", "graph", *arguments]) == 2
    assert str(tmp_path) in capfd.readouterr().err


@pytest.mark.live
def test_the_graph_is_at_work_again_after_every_kind_of_action_and_nothing_is_lost(tmp_path):
    # A process of its own: the run changes its environment.
    words = ["soak", "--minutes", "1", "--seed", "4", "--output", str(tmp_path / "soak")]
    command = [sys.executable, "-m", "trials", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    figures = json.loads(done.stdout)
    assert figures["failures"] == [], done.stderr
    assert done.returncode == 0 and figures["passed"]
    # Each kind comes once before one comes again; a busy machine does fewer in the time.
    assert sum(figures["actions"].values()) >= len(ACTIONS) // 2
    assert figures["recorded_s"] > 0.0
    assert figures["bags"]["finished"] >= 1
    assert {life["name"] for life in figures["processes"]} >= {"driver", "logger"}
