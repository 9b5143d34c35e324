"""What follows from a stage's description, compared with closed forms."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.stage.description import StageParameters, TruthParameters, true_plant
from straightcomp_ros.straightness.feedforward import FeedforwardParameters

HEIGHT, WAVES = 10e-6, 7.0  # m, rad/m


def guide(wavenumber):
    """r = -HEIGHT sin(kx), of which a map's interpolation changes nothing."""

    def evaluate(x, _):
        r, slope = -HEIGHT * np.sin(wavenumber * x), -HEIGHT * wavenumber * np.cos(wavenumber * x)
        return r, slope, -(wavenumber**2) * r

    return SimpleNamespace(evaluate=evaluate, steepest=HEIGHT * wavenumber, hysteresis=0.0, reversal=1e-4)


def fast(**changes):
    return from_mapping(StageParameters, {"motion.speed": 1.0, "motion.acceleration": 5.0, **changes})


@pytest.mark.parametrize("lead", [2e-3, 2e-2])
def test_an_extrapolated_reference_errs_by_its_third_derivative_and_by_a_ramp_of_which_it_knows_nothing(lead):
    third, ramp = HEIGHT * (WAVES * 1.0 * lead) ** 3 / 6.0, 0.5 * HEIGHT * WAVES * 5.0 * lead**2
    assert fast().outdated(guide(WAVES), lead) - ramp == pytest.approx(third, rel=0.02)


def test_a_reference_is_as_old_as_it_may_be_without_an_error_beyond_the_rounding_and_at_least_a_sample():
    stage, coarse, fine = fast(), fast(**{"encoder.y_resolution": 1e-5}), fast(**{"encoder.y_resolution": 1e-12})
    enough = stage.enough_lead(guide(WAVES), 0.02)
    assert 0.8 <= stage.outdated(guide(WAVES), enough) / stage.encoder.y_rounding <= 1.0
    assert coarse.enough_lead(guide(WAVES), 0.02) == 0.02 and fine.enough_lead(guide(WAVES), 0.02) == 5e-4


@pytest.mark.parametrize(
    ("acceleration", "resolution", "bandwidth"),
    [
        (0.2, 1e-4, 30.0),
        # As little as the rounding: 3 r' a/ω² = q/√12.
        (10.0, 1e-7, math.sqrt(3.0 * HEIGHT * WAVES * 10.0 * math.sqrt(12.0) / 1e-7) / (2.0 * math.pi)),
        # Poles that are no faster than a sample: ω = 1/T.
        (200.0, 1e-12, 2000.0 / (2.0 * math.pi)),
    ],
)
def test_tracking_is_as_fast_as_the_ramps_ask_for_and_the_samples_allow(acceleration, resolution, bandwidth):
    stage = from_mapping(StageParameters, {"motion.acceleration": acceleration, "encoder.y_resolution": resolution})
    found = stage.tracking(FeedforwardParameters(bandwidth=30.0), guide(WAVES))
    assert found == FeedforwardParameters(bandwidth=pytest.approx(bandwidth))


@pytest.mark.parametrize(("model", "other"), [("lugre", "maxwell_slip"), ("maxwell_slip", "lugre")])
def test_a_simulated_contact_is_as_described_unless_it_has_a_model_of_its_own(model, other):
    def contact(described, truth):
        stage = from_mapping(StageParameters, {"friction.model": described})
        return true_plant(stage, from_mapping(TruthParameters, truth)).contact.extension(1e6)

    described = from_mapping(StageParameters, {"friction.model": model}).plant.contact.extension(1e6)
    assert described == contact(model, {}) == contact(other, {"contact.model": model})
    assert contact(model, {"contact.model": other}) == contact(other, {}) != described
