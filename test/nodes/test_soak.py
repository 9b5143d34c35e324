"""A short soak run of the real nodes."""

import json
import subprocess
import sys

import pytest

from trials.soak_actions import ACTIONS

pytestmark = [pytest.mark.live, pytest.mark.keeps_time, pytest.mark.nightly]


def test_the_graph_is_at_work_again_after_every_kind_of_action_and_nothing_is_lost(tmp_path):
    # A process of its own: the run takes real-time priority.
    words = ["soak", "--minutes", "1", "--seed", "4", "--output", str(tmp_path / "soak")]
    command = [sys.executable, "-m", "trials", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    figures = json.loads(done.stdout)
    assert figures["failures"] == [], done.stderr
    assert done.returncode == 0 and figures["passed"]
    # Each kind comes once before one comes again; a busy machine does fewer in the time.
    assert sum(figures["actions"].values()) >= len(ACTIONS) // 2
    assert figures["strokes"]["found"] == figures["strokes"]["commanded"] > 0
    assert figures["bags"]["finished"] >= 1
    assert {life["name"] for life in figures["processes"]} >= {"driver", "logger"}
