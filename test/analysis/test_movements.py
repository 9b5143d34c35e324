"""What each movement leaves: settling, standstill and reversal."""

import math

import numpy as np
import pytest

from straightcomp_ros.analysis.metrics import standstill_figures
from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.model.motion import MotionParameters, Trajectory, forward_and_back

T = 5e-4


def record_of(error, **motion):
    """A record of a cycle of this motion with ``error(time, x)`` in m."""
    trajectory = Trajectory(forward_and_back(MotionParameters(**motion)))
    time = np.arange(0.0, trajectory.end_ns * 1e-9, T)
    x = np.array([trajectory.position(round(t * 1e9)) for t in time])
    found = error(time, x)
    zero = np.zeros_like(x)
    return StrokeRecord(time=time, x=x, y=zero - found, r=zero, current=zero, law="x")


@pytest.mark.parametrize(("stroke", "speed"), [(1e-4, 0.3), (-0.002, 0.3), (0.002, 0.001)])
def test_short_and_slow_movements_have_their_own_figures(stroke, speed):
    record = record_of(lambda time, x: 0.0 * x, stroke=stroke, speed=speed, settle=0.3, pause=0.3)
    forward, backward = record.motion.strokes
    assert forward.direction == ("forward" if stroke > 0.0 else "backward") != backward.direction
    for figures in standstill_figures(record, record.reference):
        assert (figures.settling, figures.standstill_pp, figures.standstill_rms) == (0.0, 0.0, 0.0)


def test_settling_lasts_until_the_error_stays_in_the_band_and_is_unknown_where_it_never_does():
    motion = {"stroke": 0.02, "settle": 0.2, "pause": 0.5}
    points = Trajectory(forward_and_back(MotionParameters(**motion))).waypoints
    arrival = 1e-9 * next(point.time_ns for point in points[2:] if not point.velocity)

    def decaying(time, x):
        return 3e-7 * np.exp(-np.maximum(time - arrival, 0.0) / 0.05)

    record = record_of(decaying, **motion)
    first, last = standstill_figures(record, record.reference)
    # 3e-7 falls to 1e-7 in 0.05 ln 3 s; the end of a movement is seen some ms early.
    assert first.settling == pytest.approx(0.05 * math.log(3.0), abs=0.006)
    assert first.standstill_pp < 1e-7 and last.settling == 0.0 and last.reversal_pp is None
    assert first.reversal_pp == pytest.approx(np.ptp(3e-7 * np.exp([0.0, -0.5 / 0.05])), rel=0.05)
    outside, _ = standstill_figures(record_of(lambda time, x: np.full_like(x, 2e-7), **motion), record.reference)
    assert math.isnan(outside.settling) and outside.standstill_rms == pytest.approx(2e-7)
