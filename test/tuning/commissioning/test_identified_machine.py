"""What is not as described is named at the identification; a machine that is allowed gets its facts, and no more."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import broken
import pytest
from roughly_known import TRUTH, values_of, work_on

from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.stage.uncertainty import UncertaintyParameters
from straightcomp_ros.tuning.commissioning.closed_loop import facts_found, identification, strangeness
from straightcomp_ros.tuning.commissioning.machine import sound
from straightcomp_ros.tuning.commissioning.step import Outcome
from straightcomp_ros.tuning.identification.estimate import UNITS, Estimate, Estimated

SAFE = {"control.law": "linear", "control.smc.natural_frequency": 14.0, "control.smc.phi": 13.8}
STAGE = StageParameters(uncertainty=UncertaintyParameters(mass=0.2, force=0.2, air_gap=0.1, friction=2.0))


def estimate(**factors: float) -> Estimate:
    """An exact estimate of a machine that differs from the description by factors, by the last part of the name."""
    described = to_mapping(STAGE)
    described |= {
        "actuator.current_stiffness": STAGE.actuator.current_stiffness,
        "actuator.position_stiffness": STAGE.actuator.position_stiffness,
    }
    found = {}
    for name in UNITS:
        value = described[name] * factors.get(name.partition(".")[2], 1.0)
        found[name] = Estimated(name, value, 0.99 * value, 1.01 * value, name == "platform.mass")
    return Estimate(found, None, None, None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ({"air_gap": 0.5}, "the air gap seems 0.5 times the described one"),
        ({"turns": 1.9**0.5}, "accelerates the platform 1.9 times as much as described"),
        ({"turns": 0.4**0.5}, "accelerates the platform 0.4 times as much as described"),
        ({"coulomb": 10.0}, "friction is 10 times the described one"),
        ({"coulomb": 1.9}, ""),
        ({}, ""),
    ],
)
def test_what_lies_beyond_the_uncertainty_is_named_and_nothing_else(factors: dict[str, float], words: str) -> None:
    strange = strangeness(estimate(**factors), STAGE)
    assert (words in strange) if words else strange == ""


def with_hardly_told(name: str, **factors: float) -> Estimate:
    """An estimate of a machine as by :func:`estimate`, with a wide interval of ``name`` and no amplifier of its own."""
    found = estimate(**factors)
    one = found.parameters[name]
    found.parameters[name] = dataclasses.replace(one, low=0.5 * one.value, high=2.0 * one.value)
    return dataclasses.replace(found, path=SimpleNamespace(rate_found=False))  # type: ignore[arg-type]


def test_static_friction_that_the_record_hardly_tells_keeps_its_described_ratio_to_coulomb_friction() -> None:
    facts = facts_found(with_hardly_told("friction.static", coulomb=2.5), STAGE)
    assert facts["friction.coulomb"] == pytest.approx(2.5 * STAGE.friction.coulomb)
    assert facts["friction.static"] == pytest.approx(2.5 * STAGE.friction.static)


def test_what_the_record_hardly_tells_stays_as_uncertain_as_it_was_described() -> None:
    facts = facts_found(with_hardly_told("actuator.turns", turns=1.1), STAGE)
    assert not {"actuator.turns", "uncertainty.mass", "uncertainty.force"} & set(facts)
    assert facts["uncertainty.air_gap"] < STAGE.uncertainty.air_gap


def run(machine: dict[str, float], folder: Path, wiring=sound, **stage: float) -> Outcome:
    values = values_of(machine, **stage)
    values["controller"] |= SAFE
    return identification(work_on(values, folder, wiring))


@pytest.mark.soak
@pytest.mark.parametrize(
    ("machine", "wiring", "words"),
    [
        ({}, broken.encoder_of_twice_the_count, "the count of the encoder of y"),
        ({f"{TRUTH}friction": 10.0}, sound, "friction"),
        ({f"{TRUTH}mass": 0.5}, sound, "accelerates the platform"),
    ],
    ids=["encoder of twice the count", "ten times the friction", "a loose platform"],
)
def test_a_broken_machine_is_named_and_not_tuned_around(
    machine: dict[str, float], wiring, words: str, tmp_path: Path
) -> None:
    well_known = {"mass": 0.2, "force": 0.2, "air_gap": 0.1, "friction": 2.0}
    outcome = run(machine, tmp_path, wiring, **{f"uncertainty__{name}": value for name, value in well_known.items()})
    assert not outcome.passed and words in outcome.sentence


@pytest.mark.soak
def test_a_machine_that_is_allowed_gets_its_facts_relative_to_the_described_mass(tmp_path: Path) -> None:
    truth = {f"{TRUTH}mass": 1.3, f"{TRUTH}force": 0.7, f"{TRUTH}air_gap": 0.8, f"{TRUTH}friction": 0.5}
    outcome = run(truth, tmp_path)
    assert outcome.passed, outcome.sentence
    assert outcome.stage["actuator.air_gap"] == pytest.approx(0.8 * 1.5e-3, rel=0.005)
    assert (outcome.stage["actuator.turns"] / 400.0) ** 2 == pytest.approx(0.7 / 1.3, rel=0.02)
    assert outcome.stage["friction.coulomb"] == pytest.approx(0.43 * 0.5 / 1.3, rel=0.02)
    assert "platform.mass" not in outcome.stage
    assert outcome.stage["uncertainty.force"] < 0.2
