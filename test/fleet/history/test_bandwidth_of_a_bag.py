"""The amplifier's bandwidth of a stroke comes from commands as the D/A converter of that bag rounded them."""

import dataclasses

import pytest

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.fleet.history.strokes_of_bag import Recorded, rows_of
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.parameter_file import shipped_parameters


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory):
    """A run through a coarse converter: steps of 8 mA."""
    values = shipped_parameters()
    values["stage"] |= {"motion.stroke": 0.2, "motion.settle": 0.1, "motion.pause": 0.1, "drive.dac_bits": 8}
    simulation = Simulation(values)
    folder = tmp_path_factory.mktemp("run") / "bag"
    with SimulatedRun(folder, by_node(values), simulation.delay) as run:
        simulation.run(observe=run.add)
    return evaluate_bag(folder)


def bandwidths(evaluation):
    return [row.amplifier_bandwidth_Hz for row in rows_of(evaluation, Recorded())]


def test_a_coarse_converter_leaves_the_bandwidth_as_it_is(evaluation):
    assert bandwidths(evaluation) == pytest.approx([500.0, 500.0], rel=0.02)
    driver = {**evaluation.parameters["driver"], "stage.drive.dac_bits": 12}
    another = dataclasses.replace(evaluation, parameters={**evaluation.parameters, "driver": driver})
    assert bandwidths(another) != pytest.approx([500.0, 500.0], rel=0.02)
