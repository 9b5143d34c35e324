"""The servo during a motion that is held, slowed down and let go on: as good as in one that is left alone."""

import numpy as np
import pytest

from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.straightness.residual import peak_to_peak

MOTION = {"motion.start": 0.5, "motion.stroke": 0.1, "motion.jerk": 20.0, "motion.settle": 0.6, "motion.pause": 0.1}
HELD = {2000: Pace(hold=True), 3000: Pace(0.3), 4500: Pace()}


def simulation(**controller):
    return Simulation({"stage": dict(MOTION), "controller": controller})


def test_a_held_and_overridden_stroke_ends_where_it_would_and_its_error_is_that_of_a_stroke():
    alone, paced = simulation(), simulation()
    records = alone.run(), paced.run(paces=HELD)
    assert records[1].true_x[-1] == pytest.approx(records[0].true_x[-1], abs=1e-9)
    assert records[1].time.size > records[0].time.size + 1000
    errors = [record.true_error(alone.map)[1200:] for record in records]
    assert peak_to_peak(errors[1]) < 1.1 * peak_to_peak(errors[0])
    # It stands while it is held, and the platform with it.
    assert np.ptp(records[1].true_x[2900:3000]) < 1e-9 and np.ptp(records[1].true_y[2900:3000]) < 0.2e-6


@pytest.mark.parametrize("pace", [Pace(hold=True), Pace(0.0)])
@pytest.mark.parametrize("number", [2500, 10_000])
def test_a_run_whose_motion_is_held_for_good_ends_where_it_stands(number, pace):
    held = simulation().run(paces={2000: Pace(0.1), number: pace})
    assert number < held.time.size < number + 6000
    assert 0.51 < held.true_x[-1] < 0.59 and np.ptp(held.true_x[-5:]) < 1e-7


def test_nothing_is_learned_from_a_motion_that_was_cut_short_and_the_next_one_is_learned_from():
    learned = simulation(**{"learning.learn": True})
    tables = learned._learning.tables
    learned.run(paces=HELD)
    assert [tables[way].updates for way in (True, False)] == [0, 0]
    learned.run()
    assert [tables[way].updates for way in (True, False)] == [1, 1]
