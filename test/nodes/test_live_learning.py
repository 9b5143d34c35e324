"""Learning from stroke to stroke in a graph in real time; other tests compare lockstep with the simulation."""

import numpy as np
import pytest

from straightcomp_ros.analysis.record import find_motion
from straightcomp_ros.cell.demonstration import demonstrate
from straightcomp_ros.control.learning import Learning, LearningParameters

pytestmark = [pytest.mark.nightly, pytest.mark.live, pytest.mark.keeps_time]


def test_the_graph_learns_while_it_runs_and_each_stroke_leaves_less_than_the_first(tmp_path, short_cycle):
    file = tmp_path / "learned.csv"
    # A law that lags: its error is large and repeats.
    short_cycle["controller"].update({"control.law": "linear", "learning.learn": True, "learning.file": str(file)})
    short_cycle["cell"]["strokes"] = 4
    short_cycle["stage"]["motion.settle"] = 0.3
    result = demonstrate(short_cycle, tmp_path / "demo")
    record = result.evaluation.record
    strokes = find_motion(record).strokes
    # Medians: a stall of this computer disturbs a few samples, and learning takes the update from them back.
    errors = [np.median(np.abs(record.r - record.y)[stroke.samples]) for stroke in strokes]
    assert len(errors) == 8
    assert max(errors[6:]) < 0.8 * min(errors[:2])
    learned = Learning(LearningParameters(learn=True, file=str(file)), "linear", 2000.0).counters()
    assert learned["learned_forward"] >= 3 and learned["learned_backward"] >= 3
