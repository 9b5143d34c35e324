"""A compiled cycle is the simulation, with everything that a record holds."""

from dataclasses import fields

import numpy as np
import pytest

from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import can_run, run_stroke
from straightcomp_ros.parameters.parameter_file import shipped_parameters


@pytest.fixture
def shipped():
    values = shipped_parameters()
    values["stage"]["motion.stroke"] = 0.1
    return values


def test_a_compiled_cycle_is_the_simulation_in_every_column(shipped):
    record, straightness = run_stroke(shipped)
    simulation = Simulation(shipped)
    expected = simulation.run()
    assert straightness.span == simulation.map.span
    for field in fields(expected):
        np.testing.assert_array_equal(getattr(record, field.name), getattr(expected, field.name), field.name)


def test_what_the_compiled_cycle_does_not_model_is_left_to_the_simulation(shipped):
    assert can_run(shipped)
    shipped["stage"]["drive.delay"] = 4.0
    assert can_run(shipped)
    shipped["driver"]["simulated.command_timeout"] = 0.002
    assert not can_run(shipped)
    shipped["stage"]["drive.delay"] = 0.5
    assert can_run(shipped)
    shipped["controller"]["learning.learn"] = True
    assert not can_run(shipped)
