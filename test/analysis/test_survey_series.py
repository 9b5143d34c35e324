"""A survey over time as it is read: the sensor's delay, sign and unit, and where x is not known."""

import numpy as np
import pytest

from straightcomp_ros.analysis.map_building import Sensor, is_series, series_of_bag, series_of_csv
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import DISPLACEMENT, ENCODER
from straightcomp_ros.straightness.survey import SurveyError

START_NS = 1_700_000_000_000_000_000
SPEED = 0.2


def survey_bag(path, stage_s, readings_s, reading, y=lambda t: 0.0 * t):
    """A bag of a stage at x = SPEED t, sampled at ``stage_s``, and of ``reading(t)`` at ``readings_s``."""
    with BagWriter(path) as bag:
        bag.add_topic("/encoder", ENCODER.layout.type_name)
        bag.add_topic("/displacement", DISPLACEMENT.layout.type_name)
        for t in stage_s:
            ns = START_NS + round(t * 1e9)
            bag.write("/encoder", ENCODER.layout.pack(ns, SPEED * t, float(y(t)), np.nan, np.nan), ns, ns)
        for t in readings_s:
            ns = START_NS + round(t * 1e9)
            bag.write("/displacement", DISPLACEMENT.layout.pack(ns, float(reading(t))), ns, ns)
    return path


SECOND = np.arange(0.0, 1.0001, 0.01)


@pytest.mark.parametrize("delay", [0.0, 0.02, -0.02])
def test_a_reading_belongs_to_the_x_of_the_time_before_its_delay(tmp_path, delay):
    # The sensor shows at t what was there at t − delay: with the right delay deviation and x agree again.
    bag = survey_bag(tmp_path / "bag", SECOND, SECOND, lambda t: 1e-6 * SPEED * (t - delay))
    found = series_of_bag(bag, sensor=Sensor(delay=delay))
    assert found.deviation == pytest.approx(1e-6 * found.x, abs=1e-15)
    assert found.unusable == round(abs(delay) / 0.01)
    assert (f"{delay * 1e3:g} ms old" in found.inputs["sensor"]) is (delay != 0.0)


def test_the_delay_of_the_platforms_y_is_that_of_the_reading(tmp_path):
    def y(t):
        return 3e-6 * t * t

    bag = survey_bag(tmp_path / "bag", np.arange(0.0, 1.0, 0.001), SECOND, lambda t: 1e-6 + y(t - 0.05), y)
    found = series_of_bag(bag, sensor=Sensor(delay=0.05, on_platform=True))
    assert found.deviation == pytest.approx(1e-6, abs=1e-11)
    assert "on the platform" in found.inputs["sensor"]


def test_unit_and_sign_of_the_sensor_are_those_that_are_named(tmp_path):
    bag = survey_bag(tmp_path / "bag", SECOND, SECOND, lambda t: 2.0 * t)
    assert series_of_bag(bag, sensor=Sensor(unit="mm")).deviation[-1] == pytest.approx(2e-3)
    inverted = series_of_bag(bag, sensor=Sensor(unit="um", inverted=True))
    assert inverted.deviation[-1] == pytest.approx(-2e-6)
    assert "inverted" in inverted.inputs["sensor"] and "in um" in inverted.inputs["sensor"]
    plain = series_of_bag(bag)
    assert plain.inputs["sensor"].endswith("in m") and plain.inputs["stage"].endswith("position[stage_x]")


def test_x_is_not_interpolated_over_more_than_a_tenth_of_a_second(tmp_path):
    for gap, unusable in ((0.1, 0), (0.11, 10), (0.12, 11)):
        for begin in (0.0, 0.4, 1.0 - gap):
            stage = np.array([t for t in SECOND if not begin + 0.0001 < t < begin + gap - 0.0001])
            bag = survey_bag(tmp_path / f"bag{gap}{begin}", stage, SECOND, lambda t: 1e-6)
            found = series_of_bag(bag)
            assert found.unusable == unusable
            assert found.x == pytest.approx(SPEED * found.time, abs=1e-9)


def test_readings_before_and_after_the_stages_samples_are_left_out_and_those_at_its_ends_are_not(tmp_path):
    bag = survey_bag(tmp_path / "bag", SECOND[20:81], SECOND, lambda t: 1e-6)
    found = series_of_bag(bag)
    assert found.x[[0, -1]] == pytest.approx([SPEED * 0.2, SPEED * 0.8])
    assert len(found.x) == 61 and found.unusable == 40
    assert found.time[0] == 0.0 and found.time[-1] == pytest.approx(0.6)


def test_repeated_and_disordered_samples_are_put_in_order(tmp_path):
    shuffled = np.random.default_rng(1).permutation(np.concatenate([SECOND, SECOND[:30]]))
    bag = survey_bag(tmp_path / "bag", shuffled, shuffled[::-1], lambda t: 1e-6 * t)
    found = series_of_bag(bag)
    assert found.time == pytest.approx(SECOND) and found.deviation == pytest.approx(1e-6 * SECOND)


def test_what_is_not_finite_is_left_out_and_three_samples_must_be_left(tmp_path):
    bag = survey_bag(tmp_path / "bag", SECOND, SECOND, lambda t: np.nan if t > 0.025 else 1e-6)
    assert (len(series_of_bag(bag).x), series_of_bag(bag).unusable) == (3, 98)
    bag = survey_bag(tmp_path / "less", SECOND, SECOND, lambda t: np.nan if t > 0.015 else 1e-6)
    with pytest.raises(SurveyError, match="2 common samples"):
        series_of_bag(bag)
    with pytest.raises(SurveyError, match="1 common samples"):
        series_of_bag(survey_bag(tmp_path / "one", SECOND[:1], SECOND, lambda t: 1e-6))


def test_a_recording_as_csv_starts_at_time_zero_in_metres(tmp_path):
    path = tmp_path / "series.csv"
    path.write_text("time_s,x_mm,deviation_um\n5.0,1,10\n5.5,2,20\n6.0,3,30\n")
    assert is_series(path)
    (tmp_path / "points.csv").write_text("x_mm,deviation_um\n1,10\n")
    assert not is_series(tmp_path / "points.csv")
    found = series_of_csv(path)
    assert found.time.tolist() == [0.0, 0.5, 1.0]
    assert found.x == pytest.approx([1e-3, 2e-3, 3e-3]) and found.deviation == pytest.approx([1e-5, 2e-5, 3e-5])
    assert found.unusable == 0


@pytest.mark.parametrize(
    "rows, words",
    [
        ("0,1,1\n1,2,2\n", "2 rows"),
        ("0,1,1\n2,2,2\n1,3,3\n", "line 4: time_s 1 after 2"),
        ("0,1,1\n2,2,2\n2,3,3\n", "line 4: time_s 2 after 2"),
        ("0,1,1\n1,2\n2,3,3\n", "line 3: 2 cells"),
    ],
)
def test_a_recording_as_csv_that_is_none_is_refused(tmp_path, rows, words):
    path = tmp_path / "series.csv"
    path.write_text("time_s,x_mm,deviation_um\n" + rows)
    with pytest.raises(SurveyError, match=words):
        series_of_csv(path)


def test_where_the_platforms_y_was_not_recorded_a_reading_on_it_says_nothing(tmp_path):
    hole = [t for t in np.arange(0.0, 1.0001, 0.001) if not 0.4 < t < 0.6]
    bag = survey_bag(tmp_path / "bag", hole, SECOND, lambda t: 2e-6, lambda t: 1e-6)
    found = series_of_bag(bag, sensor=Sensor(on_platform=True))
    assert found.unusable == 19 and found.deviation == pytest.approx(1e-6)
    assert not np.any((found.x > 0.41 * SPEED) & (found.x < 0.59 * SPEED))
