"""A displacement sensor that was recorded with the strokes: what its readings say of the guide, from the bag on."""

import numpy as np
import pytest

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.bags.simulated_run import START_NS, SimulatedRun
from straightcomp_ros.contract import DISPLACEMENT
from straightcomp_ros.fleet.history.strokes_of_bag import Recorded, rows_of
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.parameter_file import shipped_parameters

BUMP_UM = 0.8


def bump(x):
    return BUMP_UM * 1e-6 * (0.05 < x < 0.07)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    values = shipped_parameters()
    values["stage"] |= {"motion.stroke": 0.2, "motion.settle": 0.1, "motion.pause": 0.1}
    simulation = Simulation(values)
    folder = tmp_path_factory.mktemp("run") / "bag"
    with SimulatedRun(folder, by_node(values), simulation.delay) as run:
        bag = run._bag
        bag.add_topic("/displacement", DISPLACEMENT.layout.type_name)
        count = 0

        def observe(sample, truth, *rest):
            nonlocal count
            run.add(sample, truth, *rest)
            if count % 10 == 0:
                stamp = START_NS + sample.stamp_ns
                # The zero of the sensor is arbitrary.
                reading = 5e-6 + simulation.map.deviation(truth.x) + bump(truth.x)
                bag.write("/displacement", DISPLACEMENT.layout.pack(stamp, reading), stamp, stamp)
            count += 1

        simulation.run(observe=observe)
    return rows_of(evaluate_bag(folder), Recorded())


def test_the_guide_has_changed_where_the_sensor_saw_it(rows):
    assert [row.direction for row in rows] == ["forward", "backward"]
    for row in rows:
        middles = row.bins_from_mm + 10.0 * (np.arange(len(row.guide_change_um)) + 0.5)
        change = np.array(row.guide_change_um, np.float64)
        inside = (middles > 50) & (middles < 70)
        assert np.allclose(change[inside] - np.median(change), BUMP_UM, atol=0.05)
        assert np.abs(change[~inside] - np.median(change)).max() < 0.05


def test_the_amplifier_is_that_of_the_described_stage(rows):
    assert [row.amplifier_bandwidth_Hz for row in rows] == pytest.approx([500.0, 500.0], rel=0.01)
