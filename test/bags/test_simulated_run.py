"""`straightcomp simulate --bag` writes what the graph would have recorded."""

import json
from pathlib import Path

import numpy as np
import pytest

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.cli.main import main
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node

CYCLE = {"motion.stroke": 0.05, "motion.settle": 0.1, "motion.pause": 0.1}
VALUES = {"controller": {"control.law": "linear"}, "stage": {**CYCLE, "drive.delay": 0.5}}


def test_the_bag_of_a_simulated_run_evaluates_to_the_same_record(tmp_path: Path) -> None:
    simulation = Simulation(VALUES)
    with SimulatedRun(tmp_path / "bag", by_node(VALUES), simulation.delay) as run:
        record = simulation.run(observe=run.add)
    evaluation = evaluate_bag(tmp_path / "bag")
    assert evaluation.record.law == "linear"
    for name, column in record.columns().items():
        np.testing.assert_allclose(evaluation.record.columns()[name], column, rtol=0, atol=1e-12, err_msg=name)
    assert (evaluation.lost_samples, evaluation.lost_commands) == (0, 0)
    assert evaluation.latency_us(50) == pytest.approx(250.0)


def test_writing_the_bag_does_not_change_the_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = [word for name, value in CYCLE.items() for word in ("--set", f"stage.{name}={value}")]
    figures = []
    for extra in ([], ["--bag", str(tmp_path / "bag")]):
        assert main(["simulate", "--json", *options, *extra]) == 0
        figures.append(json.loads(capsys.readouterr().out))
    assert figures[0] == figures[1]
