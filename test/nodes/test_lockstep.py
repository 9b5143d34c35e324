"""The proof that live and offline are one code."""

import numpy as np
import pytest

from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.demonstration import demonstrate
from straightcomp_ros.simulation import Simulation


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("delay", [0.5, 1.3])
def test_the_graph_in_lockstep_equals_the_simulation_to_the_last_bit(tmp_path, short_cycle, law, delay):
    short_cycle["controller"].update({"control.law": law, "trigger": "sample"})
    short_cycle["driver"].update({"lockstep": True, "lockstep_delay": delay})
    offline = Simulation(short_cycle).run()
    live = demonstrate(short_cycle, tmp_path).evaluation
    assert live.expected_samples == live.received_samples == len(offline.x)
    for column in ("x", "y", "r", "current", "true_x", "true_y", "guide"):
        np.testing.assert_array_equal(getattr(live.record, column), getattr(offline, column), err_msg=column)
    assert live.record.law == law
    assert np.ptp(offline.current) > 0.005  # it did work for its result
