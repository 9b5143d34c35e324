"""The run-out: it starts as the survey ends, and ends flat."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from straightcomp_ros.straightness.guide_map import runout

values = st.floats(-1e-4, 1e-4)
slopes = st.floats(-1e-3, 1e-3)
curvatures = st.floats(-1e-1, 1e-1)
lengths = st.floats(1e-3, 0.5)


@given(value=values, slope=slopes, curvature=curvatures, length=lengths)
def test_value_slope_and_curvature_go_on_at_both_ends(
    value: float, slope: float, curvature: float, length: float
) -> None:
    out = runout(value, slope, curvature, length)
    p = Polynomial(out.coefficients)
    scale = 1e-13 * (abs(value) + abs(slope) * length + abs(curvature) * length**2) + 1e-300
    start, end = (
        [p.deriv(k)(0.0) if k else p(0.0) for k in range(3)],
        [p.deriv(k)(length) if k else p(length) for k in range(3)],
    )
    for k, (got, wanted) in enumerate(zip(start, (value, slope, curvature), strict=True)):
        assert abs(got - wanted) <= scale / length**k
    for k, (got, wanted) in enumerate(zip(end, (out.held, 0.0, 0.0), strict=True)):
        assert abs(got - wanted) <= 10.0 * scale / length**k


@given(value=values, slope=slopes, curvature=curvatures, length=lengths)
def test_no_value_on_the_way_lies_outside_of_start_turning_and_held(
    value: float, slope: float, curvature: float, length: float
) -> None:
    out = runout(value, slope, curvature, length)
    path = Polynomial(out.coefficients)(np.linspace(0.0, length, 201))
    # Numbers below 1e-308 have fewer digits: a floor of no size at all.
    grain = 1e-12 * (abs(value) + abs(slope) * length + abs(curvature) * length**2) + 1e-30
    assert path.max() <= max(value, out.turning, out.held) + grain
    assert path.min() >= min(value, out.turning, out.held) - grain


def test_a_straight_end_is_held_half_a_length_on() -> None:
    assert runout(1.0, 2.0, 0.0, 3.0).held == pytest.approx(4.0)
