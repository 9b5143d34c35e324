import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.model.converters import DriveParameters, EncoderParameters

ENCODER = EncoderParameters(x_resolution=1e-6, y_resolution=1e-7)
DRIVE = DriveParameters()


@given(st.floats(-2.0, 2.0))
def test_an_encoder_reading_is_a_whole_count_within_half_a_count(position):
    for reading, count in ((ENCODER.x_reading(position), 1e-6), (ENCODER.y_reading(position), 1e-7)):
        assert abs(reading - position) <= 0.5000001 * count
        assert reading / count == pytest.approx(round(reading / count), abs=1e-6)


def test_twelve_bits_over_twenty_volts_are_half_a_milliampere():
    assert DRIVE.current_step == pytest.approx(0.488e-3, abs=1e-6)


@given(st.floats(-0.99, 0.99))
def test_a_converted_current_is_within_half_a_step(current):
    assert abs(DRIVE.converted(current) - current) <= 0.5000001 * DRIVE.current_step


def test_the_converter_stops_at_its_range():
    assert DRIVE.converted(5.0) == DRIVE.current_range - DRIVE.current_step
    assert DRIVE.converted(-5.0) == -DRIVE.current_range
