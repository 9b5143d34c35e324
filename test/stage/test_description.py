"""What follows from a stage's description, compared with closed forms."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.stage.description import (
    Factors,
    StageParameters,
    TruthParameters,
    UncertaintyParameters,
    deviating,
    true_plant,
)
from straightcomp_ros.straightness.feedforward import FeedforwardParameters

HEIGHT, WAVES = 10e-6, 7.0  # m, rad/m


def guide(wavenumber):
    """r = -HEIGHT sin(kx) over the stroke, of which a map's interpolation changes nothing, and beyond it a step."""
    middle, half = StageParameters().motion.start + StageParameters().motion.stroke / 2.0, 0.5 * fast().motion.stroke

    def evaluate(x, _):
        r, slope = -HEIGHT * np.sin(wavenumber * x), -HEIGHT * wavenumber * np.cos(wavenumber * x)
        return np.where(abs(x - middle) < half + 1e-9, r, 1.0), slope, -(wavenumber**2) * r

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


def test_times_and_forces_of_a_stage_are_those_of_its_equations():
    stage = from_mapping(StageParameters, {"rate": 3000, "drive.delay": 2.0, "platform.stiffness": 5e4})
    assert (stage.period_ns, stage.period, stage.delay) == (333_333, 1.0 / 3000.0, pytest.approx(2.0 / 3000.0))
    assert stage.negative_stiffness == stage.actuator.position_stiffness - 5e4 < 0.0
    step = stage.actuator.current_stiffness * 2.0 * 0.1 * 10.0 / 4096.0
    assert stage.quantum == pytest.approx(-stage.negative_stiffness * stage.encoder.y_resolution + step)


def test_the_lightest_platform_is_as_light_as_the_sample_is_short_and_the_magnets_are_weak():
    def lightest(**facts):
        with pytest.raises(ParameterError) as refused:
            from_mapping(StageParameters, {"platform.mass": 1e-6, **facts})
        return float(str(refused.value).partition("allowed: >= ")[2].split()[0])

    slow = lightest(rate=200)
    for mass, taken in ((0.99, False), (1.01, True)):
        try:
            assert from_mapping(StageParameters, {"platform.mass": mass * slow, "rate": 200}) and taken
        except ParameterError:
            assert not taken
    assert slow / lightest(rate=600) == pytest.approx(9.0, rel=0.01)
    twice = {"actuator.turns": 2.0 * StageParameters().actuator.turns}
    assert lightest(rate=200, **twice) / slow == pytest.approx(4.0, rel=0.01)


def test_the_stop_is_inside_the_air_gap_of_the_description_and_of_the_machine():
    stage = from_mapping(StageParameters, {"platform.stop": 0.75e-3, "actuator.air_gap": 1.0e-3})
    assert deviating(stage.plant, Factors(air_gap=0.76)).actuator.air_gap == pytest.approx(0.76e-3)
    for refused in (0.75, 0.74):
        with pytest.raises(ParameterError, match=r"platform\.stop"):
            deviating(stage.plant, Factors(air_gap=refused))
    with pytest.raises(ParameterError, match=r"platform\.stop"):
        from_mapping(StageParameters, {"platform.stop": 1.0e-3, "actuator.air_gap": 1.0e-3})


def test_a_machine_is_off_its_description_by_its_factors_alone():
    modes = {"platform.modes.first.frequency": 300.0, "platform.modes.first.damping": 0.02}
    plant = from_mapping(StageParameters, modes).plant
    assert deviating(plant, Factors()) == plant
    found = deviating(plant, Factors(1.5, 1.2, 1.1, 3.0, 0.5, (1.0, -1.0, 0.5)))
    assert found.platform.mass == 1.5 * plant.platform.mass and found.drive.bandwidth == 0.5 * plant.drive.bandwidth
    # (3): K_i goes with the force and one over the square of the gap.
    stiffer = found.actuator.current_stiffness / plant.actuator.current_stiffness
    assert stiffer == pytest.approx(1.2 / 1.1**2)
    for name in ("coulomb", "static", "viscous", "bristle_stiffness"):
        factor = 1.0 if name == "bristle_stiffness" else 3.0
        assert getattr(found.friction, name) == factor * getattr(plant.friction, name)
    (mode,), (known,) = found.platform.modes.present, plant.platform.modes.present
    assert mode.frequency == pytest.approx(300.0 * (1.0 + known.frequency_error))
    assert mode.damping == pytest.approx(0.02 / known.damping_factor)
    assert mode.residue == pytest.approx(known.residue * (1.0 + 0.5 * known.participation_error))


def test_the_simulated_platform_has_resonances_of_its_own_or_those_that_are_described():
    stage = from_mapping(StageParameters, {"platform.modes.first.frequency": 300.0})
    for truth, frequency in (({}, 300.0), ({"modes.second.frequency": 500.0}, 500.0)):
        modes = true_plant(stage, from_mapping(TruthParameters, truth)).platform.modes
        assert [mode.frequency for mode in modes.present] == [frequency]


def test_the_corners_of_what_is_uncertain_are_its_fractions_and_its_factors():
    known = from_mapping(
        UncertaintyParameters, {"mass": 0.1, "force": 0.2, "air_gap": 0.3, "friction": 4.0, "amplifier": 9.0}
    )
    assert known.factors(1.0, -1.0, 0.5, -0.5, 0.5)[:5] == pytest.approx((1.1, 0.8, 1.15, 0.5, 3.0))
    assert known.factors(0.0, 0.0, 0.0, 0.0) == Factors()
    assert from_mapping(UncertaintyParameters, {"shortest_delay": 1.0, "longest_delay": 1.0}).longest_delay == 1.0
    with pytest.raises(ParameterError, match="longest_delay"):
        from_mapping(UncertaintyParameters, {"shortest_delay": 1.1, "longest_delay": 1.0})
