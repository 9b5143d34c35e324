"""Margins of loops whose margins are known by hand."""

import numpy as np
import pytest

from straightcomp_ros.tuning.frequency_response.measured_response import response_margins

F = np.geomspace(0.1, 100.0, 3000)
S = 2j * np.pi * F


def test_an_integrator_with_a_delay_has_the_textbooks_margins():
    delay, gain = 0.01, 50.0
    found = response_margins(F, gain * np.exp(-S * delay) / S)
    # ω_c = k, φ = 90° − k τ; ω_180 = π/(2τ), gain margin π/(2 k τ)
    assert found.crossover_Hz == pytest.approx(gain / (2.0 * np.pi), rel=1e-4)
    assert found.phase_deg == pytest.approx(90.0 - np.degrees(gain * delay), abs=0.01)
    assert found.gain_high == pytest.approx(np.pi / (2.0 * gain * delay), rel=1e-4)
    assert found.gain_low is None
    assert found.delay_us == pytest.approx((np.pi / (2.0 * gain) - delay) * 1e6, rel=1e-4)
    assert found.sensitivity_peak == pytest.approx(np.abs(1.0 / (1.0 + gain * np.exp(-S * delay) / S)).max())


def test_what_lies_beyond_the_lines_is_not_known():
    found = response_margins(F[F < 5.0], 50.0 / S[F < 5.0])
    assert found[:5] == (None,) * 5


def test_a_delay_turns_the_loop_only_one_way():
    # Phase of −L at the crossover is −30°: the critical point lies behind, so a delay has to turn L by 330°.
    loop = np.full(F.shape, -np.exp(-1j * np.radians(30.0))) * (10.0 / F)
    found = response_margins(F, loop)
    assert found.phase_deg == pytest.approx(30.0)
    assert found.delay_us == pytest.approx(330.0 / 360.0 / 10.0 * 1e6, rel=1e-4)


def test_lines_that_are_not_finite_are_left_out_and_no_line_has_no_margins():
    loop = 50.0 * np.exp(-S * 0.01) / S
    whole, holed = response_margins(F, loop), loop.copy()
    holed[[3, 40]] = np.nan
    assert response_margins(F, holed) == whole
    assert response_margins(F, np.full(F.shape, np.nan + 0j)) == (None,) * 7
    assert response_margins(F[:0], loop[:0]) == (None,) * 7
