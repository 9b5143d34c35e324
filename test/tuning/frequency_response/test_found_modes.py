"""Resonances are found in a measured plant, with intervals that hold them, and none where there is none."""

import dataclasses

import numpy as np
import pytest

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.margins import loop_response
from straightcomp_ros.model.modes import ModeParameters
from straightcomp_ros.parameters.declaration import from_mapping, to_mapping
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.frequency_response.found_modes import Interval, found_plant

STAGE = StageParameters()
FREQUENCIES = np.geomspace(2.0, 500.0, 40)
DAMPING = 800.0


def found(truth, described=STAGE, noise=0.01, seed=1, off=1.0, lines=FREQUENCIES, damping=DAMPING):
    """The mechanics of the plant of ``truth``, 3 % stronger and 20 % more damped than described, with relative noise,
    and with one line ``off`` times as strong."""
    law, random = make_law(ControlParameters(), STAGE), np.random.default_rng(seed)
    plant = 1.03 * loop_response(law, truth, lines, 1.2 * damping).plant
    real, imaginary = random.standard_normal((2, lines.size))
    noisy = plant * (1.0 + noise * (real + 1j * imaginary) / np.sqrt(2.0))
    noisy[12] *= off
    rigid = loop_response(law, described.with_modes(), lines, damping).plant
    return found_plant(lines, noisy, 2.0 * noise * np.abs(plant), rigid, damping, described)


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
    plant = found(STAGE.with_modes(mode))
    (one,) = plant.modes
    assert plant.gain.value == pytest.approx(1.03, rel=0.02)
    assert one.frequency.low <= mode.frequency <= one.frequency.high
    assert one.frequency.value == pytest.approx(mode.frequency, rel=0.02)
    assert one.residue.value == pytest.approx(mode.residue, rel=0.25)
    assert one.damping.low <= mode.damping <= one.damping.high
    assert not one.described and "no description" in one.text


def test_a_found_mode_is_named_as_described_and_becomes_facts_of_a_description():
    mode = ModeParameters(180.0, 0.02, 1.0, -1.0)
    (one,) = found(STAGE.with_modes(mode), described=STAGE.with_modes(mode)).modes
    assert one.described == "stage.platform.modes.first, 180 Hz"
    stage = from_mapping(StageParameters, {**to_mapping(STAGE), **one.facts("second")})
    assert stage.platform.modes.second.frequency == pytest.approx(180.0, rel=0.02)
    assert stage.platform.modes.second.residue == pytest.approx(-1.0, rel=0.2)


def test_of_two_modes_within_the_range_of_a_described_one_the_nearer_is_it_and_the_other_is_in_no_description():
    near, other = ModeParameters(185.0, 0.02, 0.5, 0.5), ModeParameters(215.0, 0.02, 0.5, -0.5)
    roughly = ModeParameters(190.0, 0.02, 0.5, 0.5, frequency_error=0.2)
    modes = found(STAGE.with_modes(near, other), described=STAGE.with_modes(roughly)).modes
    assert [one.described for one in modes] == ["stage.platform.modes.first, 190 Hz", ""]


def test_where_friction_outweighs_the_mass_no_mode_is_looked_for_and_one_that_lies_there_is_a_part_of_the_gain():
    # 800 N·s/m outweigh 5 kg below 25 Hz.
    low, high = ModeParameters(8.0, 0.1, 0.5, 0.5), ModeParameters(300.0, 0.01, 0.4, -0.4)
    plant = found(STAGE.with_modes(low, high))
    (one,) = plant.modes
    assert one.frequency.value == pytest.approx(300.0, rel=0.02)
    assert plant.gain.value == pytest.approx(1.03 * 1.25, rel=0.03)
    assert one.residue.value == pytest.approx(-0.16 / 1.25, rel=0.25)


HIDING = ModeParameters(69.9, 0.012, 0.34, 0.34), ModeParameters(135.3, 0.012, 0.28, -0.28)
"""One line shows each."""
OVERLAPPING = ModeParameters(92.9, 0.009, 0.191, 0.191), ModeParameters(104.1, 0.0227, 0.32, 0.32)
"""Within an eighth of their frequency, so that lines have to lie closer."""
FINE = np.unique(np.round(4.0 * np.geomspace(2.0, 500.0, 200))) / 4.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("modes", "noise", "lines"), [(HIDING, 0.01, FREQUENCIES), (OVERLAPPING, 0.02, FINE)])
def test_two_modes_that_hide_each_other_or_overlap_are_found_in_order_of_frequency(modes, noise, lines, seed):
    plant = found(STAGE.with_modes(*modes), noise=noise, seed=seed, lines=lines)
    for one, mode in zip(plant.modes, modes, strict=True):
        assert one.frequency.value == pytest.approx(mode.frequency, rel=0.01)
        assert one.residue.value == pytest.approx(mode.residue, rel=0.25)


def test_two_modes_that_few_lines_take_for_one_are_found_where_they_are_described():
    unknown, known = (
        found(STAGE.with_modes(*OVERLAPPING), described=STAGE.with_modes(*modes)) for modes in ((), OVERLAPPING)
    )
    (between,) = unknown.modes
    assert 94.0 < between.frequency.value < 103.0 and not between.described
    assert [one.frequency.value for one in known.modes] == pytest.approx([92.9, 104.1], rel=0.01)
    assert all(one.described for one in known.modes)


def test_a_flexure_is_no_mode_and_takes_nothing_from_one():
    guided = dataclasses.replace(STAGE, platform=dataclasses.replace(STAGE.platform, stiffness=3e5, damping=50.0))
    mode = ModeParameters(150.0, 0.01, 0.3, -0.3)
    (one,) = found(guided.with_modes(mode), described=guided, damping=0.0).modes
    assert one.frequency.value == pytest.approx(150.0, rel=0.01) and one.residue.value == pytest.approx(-0.09, rel=0.1)


def test_the_ratio_of_two_values_is_as_wide_as_both_together():
    ratio = Interval(2.0, 1.8, 2.2).over(Interval(1.0, 0.95, 1.05))
    assert ratio.value == 2.0 and ratio.high / 2.0 == pytest.approx(1.114, abs=0.001) and ratio.low < 1.8


def test_what_the_lines_do_not_determine_has_a_wide_interval_and_no_nan(monkeypatch):
    monkeypatch.setattr(np.linalg, "pinv", lambda matrix: -1e-18 * np.eye(len(matrix)))
    gain, (mode,) = found(STAGE.with_modes(ModeParameters(180.0, 0.01, 1.0, -1.0)))
    assert gain.high > 1e3 * gain.value and mode.frequency.high > 1e3 * mode.frequency.value
    assert np.isfinite([*gain, *mode.frequency, *mode.damping, *mode.residue]).all()
