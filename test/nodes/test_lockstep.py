"""The proof that live and offline are one code."""

import itertools
import shutil

import numpy as np
import pytest

from straightcomp_ros.cell.demonstration import demonstrate
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.offline.simulation import Simulation


@pytest.mark.parametrize(
    ("law", "delay"),
    [
        pytest.param(law, delay, marks=[] if (law, delay) == ("smc_observer", 0.5) else [pytest.mark.nightly])
        for law, delay in itertools.product(LAWS, (0.5, 1.2))
    ],
)
def test_the_graph_in_lockstep_equals_the_simulation_to_the_last_bit(tmp_path, in_lockstep, law, delay):
    in_lockstep["controller"]["control.law"] = law
    # The delay is the one that is described.
    in_lockstep["stage"].update({"drive.delay": delay, "uncertainty.longest_delay": 1.0})
    offline = Simulation(in_lockstep).run()
    live = demonstrate(in_lockstep, tmp_path).evaluation
    assert live.expected_samples == live.received_samples == len(offline.x)
    for column in ("x", "y", "r", "current", "true_x", "true_y", "guide"):
        np.testing.assert_array_equal(getattr(live.record, column), getattr(offline, column), err_msg=column)
    assert live.record.law == law
    assert np.ptp(offline.current) > 0.005  # it did work for its result


@pytest.mark.nightly
def test_the_graph_learns_in_lockstep_what_the_simulation_learns(tmp_path, in_lockstep):
    in_lockstep["controller"].update({"control.law": "linear", "learning.learn": True})
    here, there = tmp_path / "offline.csv", tmp_path / "live.csv"
    in_lockstep["controller"]["learning.file"] = str(here)
    first = Simulation(in_lockstep)
    bare = first.run()
    first.run()
    first.save_learning()
    shutil.copy(here, there)
    again = Simulation(in_lockstep)
    offline = again.run()
    again.save_learning()
    in_lockstep["controller"]["learning.file"] = str(there)
    live = demonstrate(in_lockstep, tmp_path).evaluation
    assert live.expected_samples == live.received_samples == len(offline.x)
    for column in ("y", "r", "current", "true_y"):
        np.testing.assert_array_equal(getattr(live.record, column), getattr(offline, column), err_msg=column)
    assert there.read_bytes() == here.read_bytes()
    assert (offline.current != bare.current).any()  # what was learned was applied
