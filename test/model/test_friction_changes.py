"""Friction that varies along y, grows at rest, and steps in time."""

import math

import numpy as np
import pytest
from contact import SLIP, UNDAMPED, Contact, run

from straightcomp_ros.model.friction import age_after, band_factor, band_value, rest_factor
from straightcomp_ros.model.plant import PlantState


@pytest.mark.parametrize(
    "nothing",
    [
        {"contact.bands.width": 1e-5, "contact.bands.seed": 3},
        {"contact.step.time": 0.01, "contact.rest.time": 2.0},
        {"contact.maxwell_slip.blocks": 8},
    ],
)
def test_changes_of_no_size_are_plain_lugre(nothing):
    start = PlantState(velocity=1e-4, bias=1.0)
    np.testing.assert_array_equal(run(nothing, start, 0.02, 20), run({}, start, 0.02, 20))


def test_a_step_that_has_not_come_is_plain_lugre():
    start = PlantState(velocity=1e-4, bias=1.0)
    late = run({"contact.step.factor": 3.0, "contact.step.time": 1.0}, start, 0.02, 20)
    np.testing.assert_allclose(late[:, :7], run({}, start, 0.02, 20)[:, :7], rtol=1e-12)


@pytest.mark.parametrize("model", ["lugre", "maxwell_slip"])
def test_bands_too_small_to_matter_are_none(model):
    start = PlantState(velocity=1e-4, bias=1.0)
    banded = run({"contact.model": model, "contact.bands.fraction": 1e-12}, start, 0.02, 20)
    none = run({"contact.model": model}, start, 0.02, 20)
    np.testing.assert_allclose(banded[:, :7], none[:, :7], rtol=1e-6)


def test_bands_vary_up_to_the_fraction_smoothly_and_by_the_seed_alone():
    y = np.linspace(-1e-4, 1e-4, 20001)
    factors = np.array([band_factor(0.3, 2e-6, 5, place) for place in y.tolist()])
    assert 0.7 <= factors.min() < 0.75 and 1.25 < factors.max() <= 1.3
    # Slope of the cubic: 1.5 times the largest change over the band's width.
    assert np.abs(np.diff(factors)).max() <= 1.5 * 0.6 * 1e-8 / 2e-6 * (1 + 1e-6)
    assert factors.tolist() == [band_factor(0.3, 2e-6, 5, place) for place in y.tolist()]
    assert factors.tolist() != [band_factor(0.3, 2e-6, 6, place) for place in y.tolist()]


def test_values_of_the_bands_are_spread_evenly_and_are_the_same_on_every_machine():
    values = np.array([band_value(1, band) for band in range(-5000, 5000)])
    assert np.abs(values).max() <= 1.0
    assert values.mean() == pytest.approx(0.0, abs=0.03) and values.var() == pytest.approx(1 / 3, rel=0.05)
    assert abs(np.corrcoef(values[1:], values[:-1])[0, 1]) < 0.05


def test_sliding_force_follows_the_bands():
    contact = Contact({**SLIP, **UNDAMPED, "contact.bands.fraction": 0.3, "contact.maxwell_slip.attraction": 1e9})
    contact.go(1e-5, 1e-3)
    forces, factors = [], []
    for _ in range(500):
        forces.append(contact.move(1e-3))
        factors.append(band_factor(0.3, 2e-6, 0, contact.place))
    np.testing.assert_allclose(forces, 0.43 * np.array(factors), rtol=0.05)


def test_age_is_the_time_at_rest_and_sliding_renews_the_contact():
    assert age_after(2.0, 0.0, 3.0, 5e-6) == 5.0
    assert age_after(100.0, 1e-3, 1.0, 5e-6) == pytest.approx(5e-6 / 1e-3)
    half = age_after(age_after(2.0, 1e-6, 0.5, 5e-6), 1e-6, 0.5, 5e-6)
    assert half == pytest.approx(age_after(2.0, 1e-6, 1.0, 5e-6))
    assert age_after(2.0, 1e-17, 3.0, 5e-6) == pytest.approx(age_after(2.0, 1e-14, 3.0, 5e-6), rel=1e-6)


def test_static_friction_grows_with_the_logarithm_of_rest_up_to_its_bound():
    assert rest_factor(0.1, 1.0, 2.0, 0.0) == 1.0
    assert rest_factor(0.1, 1.0, 2.0, math.e - 1.0) == pytest.approx(1.1)
    assert rest_factor(0.1, 1.0, 2.0, 1e9) == 2.0


@pytest.mark.parametrize("model", ["lugre", "maxwell_slip"])
def test_the_longer_the_rest_the_higher_the_break_away_force(model):
    peaks = []
    for rest in (0.0, 1.0, 10.0, 1e9):
        contact = Contact({**UNDAMPED, "contact.model": model, "contact.rest.growth": 0.2})
        contact.move(0.0, rest)
        peaks.append(max(contact.go(1e-5, 2e-6, 2000)))
    assert peaks == sorted(peaks) and len(set(peaks)) == 4
    assert 0.75 < peaks[-1] <= 0.43 + 2.0 * (0.645 - 0.43)


@pytest.mark.parametrize("model", ["lugre", "maxwell_slip"])
def test_a_step_multiplies_the_sliding_force_from_its_time_on(model):
    contact = Contact({**UNDAMPED, "contact.model": model, "contact.step.factor": 2.0, "contact.step.time": 0.1})
    forces = [contact.move(1e-2) for _ in range(8000)]
    assert forces[3900] == pytest.approx(0.43, rel=1e-3)
    assert forces[-1] == pytest.approx(0.86, rel=1e-3)
