"""When the stage moved: from first to last motion, whatever the encoder's last digit does."""

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from straightcomp_ros.analysis.record import MetricsError, StrokeRecord, find_motion

REST, LEG = 0.25, 1.76 / 0.3 + 1.5


def _times(record: StrokeRecord, start, stop):
    return float(record.time[start]), float(record.time[stop - 1])


def test_a_cycle_is_a_forward_and_a_backward_stroke(make_record):
    record = make_record()
    motion = find_motion(record)
    forward, backward = motion.strokes
    assert (forward.direction, backward.direction) == ("forward", "backward")
    # Drawn in by 1 µm, which at 0.2 m/s² takes 3.2 ms.
    for stroke, begin in ((forward, REST), (backward, 2.0 * REST + LEG)):
        start, stop = _times(record, stroke.start, stroke.stop)
        assert begin < start < begin + 4.5e-3
        assert begin + LEG - 4.5e-3 < stop < begin + LEG


def test_the_window_holds_the_pause_and_the_strokes_do_not(make_record):
    motion = find_motion(make_record())
    forward, backward = motion.strokes
    assert motion.window == slice(forward.start, backward.stop)
    samples = motion.samples()
    assert samples.size == motion.samples("forward").size + motion.samples("backward").size
    pause = np.arange(forward.stop, backward.start)
    assert pause.size > 0.24 / 5e-4 and not np.isin(pause, samples).any()


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_jitter_of_the_encoder_makes_no_stroke(make_record, seed):
    record = make_record()
    jitter = np.random.default_rng(seed).integers(-2, 3, record.x.size) * 1e-7
    motion = find_motion(dataclasses.replace(record, x=record.x + jitter))
    assert [stroke.direction for stroke in motion.strokes] == ["forward", "backward"]
    assert motion.window.start == pytest.approx(find_motion(record).window.start, abs=4)


def test_lost_samples_do_not_split_a_stroke(make_record):
    record = make_record()
    kept = np.random.default_rng(2).random(record.time.size) > 0.3
    columns = {name: values[kept] for name, values in record.columns().items()}
    assert len(find_motion(StrokeRecord(law="x", **columns)).strokes) == 2


def test_a_record_that_begins_in_motion_counts_from_its_beginning(make_record):
    record = make_record()
    columns = {name: values[4000:10_000] for name, values in record.columns().items()}
    motion = find_motion(StrokeRecord(law="x", **columns))
    assert motion.window.start <= 1 and motion.window.stop >= 5999
    assert [stroke.direction for stroke in motion.strokes] == ["forward"]
    assert motion.samples("backward").size == 0


def test_a_stage_that_stands_is_refused(make_record):
    record = make_record()
    with pytest.raises(MetricsError, match=r"does not move: x stays within 0.0002 mm"):
        find_motion(dataclasses.replace(record, x=np.where(np.arange(record.x.size) % 2 == 0, 0.5, 0.5 + 2e-7)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"current": np.zeros(2)}, r"current has shape \(2,\), time has \(3,\)"),
        ({"time": np.zeros((1, 3))}, r"time has shape \(1, 3\)"),
        ({"true_y": np.zeros(3)}, "true_y only"),
        (dict.fromkeys(("time", "x", "y", "r", "current"), np.array([0.0, 1.0])), "2 samples"),
    ],
)
def test_columns_that_make_no_record_are_refused(change, words):
    columns = dict.fromkeys(("time", "x", "y", "r", "current"), np.zeros(3)) | change
    with pytest.raises(MetricsError, match=words):
        find_motion(StrokeRecord(law="x", **columns))
