"""A figure's name becomes words and a unit."""

import pytest

from straightcomp_ros.analysis.figure_words import heading, in_words


@pytest.mark.parametrize(
    ("name", "words", "unit"),
    [
        ("encoder_pp_um", "compensation error p-p, encoder", "µm"),
        ("encoder_pp_forward_um", "compensation error p-p, encoder, forward", "µm"),
        ("encoder_pp_95_um", "encoder pp 95", "µm"),
        ("encoder_pp_um_95", "compensation error p-p, encoder, ± (95 %)", "µm"),
        ("lost_samples", "samples lost", ""),
        ("settling_median_s", "settling time, median", "s"),
        ("error_rms_10_100_Hz_um", "error RMS from 10 to 100 Hz", "µm"),
        ("straightness_before_end_points_backward_um", "straightness before, end points, backward", "µm"),
        ("after_least_squares_um", "after, least squares", "µm"),
        ("latency_p99_us", "loop latency p99", "µs"),
        ("lateness_max_us", "publication after the sample, max", "µs"),
        ("phase_deg", "phase margin", "°"),
        ("tilt_um_per_m", "tilt", "µm/m"),
        ("travel_mm", "travel", "mm"),
        ("mode_Hz", "mode", "Hz"),
    ],
)
def test_a_name_is_read_as_words_and_a_unit(name, words, unit):
    assert in_words(name) == (words, unit)
    assert heading(name) == (f"{words} / {unit}" if unit else words)
