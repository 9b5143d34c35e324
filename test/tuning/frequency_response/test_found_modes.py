"""Resonances are found in a measured plant, with intervals that hold them, and none where there is none."""

import numpy as np
import pytest

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.margins import loop_response
from straightcomp_ros.model.modes import ModeParameters
from straightcomp_ros.parameters.declaration import from_mapping, to_mapping
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.frequency_response.found_modes import FoundMode, FoundPlant, Interval, found_plant

STAGE = StageParameters()
FREQUENCIES = np.geomspace(2.0, 500.0, 40)
DAMPING = 800.0


def with_modes(*modes):
    return STAGE.with_modes(*modes)


def found(truth, described=STAGE, noise=0.01, seed=1, off=1.0):
    """The mechanics of the plant of ``truth``, 3 % stronger and 20 % more damped than described, with relative noise,
    and with one line ``off`` times as strong."""
    law, random = make_law(ControlParameters(), STAGE), np.random.default_rng(seed)
    plant = 1.03 * loop_response(law, truth, FREQUENCIES, 1.2 * DAMPING).plant
    noisy = plant * (1.0 + noise * (random.standard_normal(40) + 1j * random.standard_normal(40)) / np.sqrt(2.0))
    noisy[12] *= off
    rigid = loop_response(law, STAGE, FREQUENCIES, DAMPING).plant
    return found_plant(FREQUENCIES, noisy, 2.0 * noise * np.abs(plant), rigid, DAMPING, described)


@pytest.mark.parametrize("seed", range(5))
def test_in_a_rigid_platform_no_mode_is_found_even_if_one_line_is_off(seed):
    plain, off = found(STAGE, seed=seed), found(STAGE, noise=0.002, seed=seed, off=0.97)
    assert plain.modes == off.modes == ()
    assert plain.gain.low <= 1.03 <= plain.gain.high and plain.gain.value == pytest.approx(1.03, abs=0.01)


@pytest.mark.parametrize(
    "mode",
    [
        ModeParameters(180.0, 0.01, 1.0, -1.0),
        ModeParameters(350.0, 0.01, 1.0 / 3.0, 1.0 / 3.0),
        ModeParameters(90.0, 0.03, 0.5, -0.5),
    ],
)
def test_a_mode_is_found_with_intervals_that_hold_it(mode):
    plant = found(with_modes(mode))
    (one,) = plant.modes
    assert plant.gain.value == pytest.approx(1.03, rel=0.02)
    assert one.frequency.low <= mode.frequency <= one.frequency.high
    assert one.frequency.value == pytest.approx(mode.frequency, rel=0.02)
    assert one.residue.value == pytest.approx(mode.residue, rel=0.25)
    assert one.damping.low <= mode.damping <= one.damping.high
    assert not one.described and "no description" in one.text


def test_two_modes_are_found_in_order_of_frequency():
    modes = found(with_modes(ModeParameters(350.0, 0.02, 1.0, -1.0), ModeParameters(160.0, 0.02, 0.5, 0.5))).modes
    assert [one.frequency.value for one in modes] == pytest.approx([160.0, 350.0], rel=0.03)


@pytest.mark.parametrize("seed", range(3))
def test_two_modes_that_one_line_each_shows_hide_each_other_and_are_found(seed):
    modes = ModeParameters(69.9, 0.012, 0.34, 0.34), ModeParameters(135.3, 0.012, 0.28, -0.28)
    first, second = found(with_modes(*modes), seed=seed).modes
    for one, mode in ((first, modes[0]), (second, modes[1])):
        assert one.frequency.value == pytest.approx(mode.frequency, rel=0.02)
        assert one.residue.value == pytest.approx(mode.residue, rel=0.25)


def test_a_found_mode_is_named_as_described_and_becomes_facts_of_a_description():
    mode = ModeParameters(180.0, 0.02, 1.0, -1.0)
    (one,) = found(with_modes(mode), described=with_modes(mode)).modes
    assert one.described == "stage.platform.modes.first, 180 Hz"
    stage = from_mapping(StageParameters, {**to_mapping(STAGE), **one.facts("second")})
    assert stage.platform.modes.second.frequency == pytest.approx(180.0, rel=0.02)
    assert stage.platform.modes.second.residue == pytest.approx(-1.0, rel=0.2)


def test_beyond_a_frequency_a_mode_below_it_is_a_part_of_the_gain_and_the_others_are_relative_to_that():
    low, high = (FoundMode(Interval(f, f - 1.0, f + 1.0), *2 * (Interval(0.2, 0.1, 0.3),), "") for f in (7.0, 300.0))
    plant = FoundPlant(Interval(1.0, 1.0 / 1.02, 1.02), (low, high))
    assert plant.above(5.0) is plant
    beyond = plant.above(20.0)
    assert beyond.gain.value == pytest.approx(1.2) and beyond.gain.high > 1.2 * 1.08
    assert [mode.frequency for mode in beyond.modes] == [high.frequency]
    assert beyond.modes[0].residue == pytest.approx((0.2 / 1.2, 0.1 / 1.2, 0.3 / 1.2))
    # All of the mass hidden behind a mode: nothing is known.
    assert FoundPlant(plant.gain, (low._replace(residue=Interval(-1.0, -1.1, -0.9)),)).above(20.0) == FoundPlant()


def test_the_ratio_of_two_values_is_as_wide_as_both_together():
    ratio = Interval(2.0, 1.8, 2.2).over(Interval(1.0, 0.95, 1.05))
    assert ratio.value == 2.0 and ratio.high / 2.0 == pytest.approx(1.114, abs=0.001) and ratio.low < 1.8


def test_what_the_lines_do_not_determine_has_a_wide_interval_and_no_nan(monkeypatch):
    monkeypatch.setattr(np.linalg, "pinv", lambda matrix: -1e-18 * np.eye(len(matrix)))
    gain, (mode,) = found(with_modes(ModeParameters(180.0, 0.01, 1.0, -1.0)))
    assert gain.high > 1e3 * gain.value and mode.frequency.high > 1e3 * mode.frequency.value
    assert np.isfinite([*gain, *mode.frequency, *mode.damping, *mode.residue]).all()
