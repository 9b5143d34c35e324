import dataclasses

import numpy as np
import pytest

from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.tuning.paper import recovery
from straightcomp_ros.tuning.paper.gain_error import FAR


@pytest.fixture(scope="module")
def limited(machine):
    return machine.with_limit(machine.plant.actuator.bias_current)


@pytest.fixture(scope="module")
def data(machine):
    return recovery.recovery(machine, points=21)


def claims_about(data, text):
    return [claim for claim in data.claims if text in claim.name]


@pytest.mark.parametrize("a", [-0.7, -0.3, 0.0, 0.4, 0.7])
def test_the_physical_limit_is_what_full_current_does_in_a_machine_without_lag_and_friction(machine, a):
    """The closed form is an integral of (2); the simulation knows nothing of it."""
    drive = dataclasses.replace(machine.plant.drive, bandwidth=1e6)
    plant = dataclasses.replace(machine.plant, drive=drive)
    stage = dataclasses.replace(machine.stage, rate=100_000, drive=dataclasses.replace(drive, delay=0.0))
    ideal = dataclasses.replace(machine, plant=plant, stage=stage).without_friction()
    y = a * ideal.plant.actuator.air_gap
    limit = recovery.fastest_outward(ideal, y)
    assert (
        recovery.least_peak(ideal, y, 0.99 * limit)
        < ideal.plant.platform.stop
        < recovery.least_peak(ideal, y, 1.01 * limit)
    )
    assert recovery.possible(ideal, y, 0.99 * limit) and not recovery.possible(ideal, y, 1.01 * limit)


@pytest.mark.parametrize("law", LAWS)
def test_every_law_recovers_from_the_centre_and_from_fig_4_but_not_from_beyond_the_stop(limited, law):
    one = limited.with_law(law)
    assert recovery.peak(one, 0.0) < 1e-6
    assert recovery.recovers(one, FAR * one.plant.actuator.air_gap)
    assert not recovery.recovers(one, 1.05 * one.plant.platform.stop)


def test_more_current_recovers_from_further_out(limited):
    one = limited.with_law("smc")
    full = one.plant.actuator.bias_current
    reached = [recovery.largest_release(one.with_limit(part * full)) for part in (0.4, 0.7, 1.0)]
    assert reached == sorted(reached) and reached[0] < 0.9 * reached[-1] < one.plant.platform.stop


def test_no_law_reaches_beyond_what_the_amplifier_leaves_and_that_not_beyond_physics(data):
    leaves = data.least_peaks < data.machine.plant.platform.stop
    assert 0 < leaves.sum() < data.possible.sum()
    assert not (leaves & ~data.possible).any()
    for law in LAWS:
        assert data.region(law).any()
        assert not (data.region(law) & ~leaves).any()


def test_what_is_mirrored_is_what_is_computed(data):
    one = data.machine.with_law("smc_observer")
    row, column = 7, 12
    assert data.grid.velocities[row] < 0.0
    computed = recovery.peak(one, data.grid.positions[column], data.grid.velocities[row])
    assert np.isfinite(computed)
    assert data.peaks["smc_observer"][row, column] == pytest.approx(computed, abs=1e-6)


def test_the_claims_say_that_only_the_unclamped_law_is_lost_at_fig_4(data):
    published, *ours = claims_about(data, "recovers from")
    assert (published.paper, published.ours, published.within) == (0.0, 0.0, True)
    assert [claim.ours for claim in ours] == [1.0] * len(LAWS)


def test_the_claims_on_the_regions_are_parts_of_the_physical_limit(data):
    published, *ours = (claim.ours for claim in claims_about(data, "region of recovery"))
    (amplifier,) = claims_about(data, "amplifier and the delay")
    assert 0.0 < published < min(ours)
    assert max(ours) <= amplifier.ours < 1.0
