"""The truth lies in the intervals, and the intervals are as narrow as they should be, or said to be wide."""

from collections.abc import Mapping
from pathlib import Path

import pytest
from plants import SOFT, STIFF

from straightcomp_ros.identification.estimate import DERIVED, estimate_from_bag, parameter_file
from straightcomp_ros.model.actuator import ActuatorParameters
from straightcomp_ros.settings.declaration import to_mapping
from straightcomp_ros.stage.description import StageParameters

START = StageParameters()
WITHIN = {
    "platform.mass": 0.01,
    "actuator.air_gap": 0.002,
    "friction.coulomb": 0.005,
    "friction.static": 0.15,
    "friction.stribeck_velocity": 0.15,
    "friction.bristle_stiffness": 0.03,
    "friction.bristle_damping": 0.15,
    "friction.viscous": 0.03,
}
"""Relative errors that an excited plant stays below."""


def truth_of(plant: Mapping[str, float]) -> dict[str, float]:
    whole = {**to_mapping(START), **plant}
    magnets = ActuatorParameters(
        **{name.partition(".")[2]: whole[name] for name in whole if name.startswith("actuator.")}
    )
    return {**whole, **{name: getattr(magnets, name.removeprefix("actuator.")) for name in DERIVED}}


def test_an_excited_plant_is_found_within_its_intervals_and_within_stated_bounds(stiff_answer) -> None:
    answer, _ = stiff_answer
    truth = truth_of(STIFF)
    for name, found in answer["parameters"].items():
        assert found["low"] <= truth[name] * (1 + 1e-9) and truth[name] <= found["high"] * (1 + 1e-9), name
        assert not found["poorly_determined"], name
        if name in WITHIN:
            assert found["value"] == pytest.approx(truth[name], rel=WITHIN[name]), name


@pytest.mark.soak
def test_another_plant_under_another_law_is_found_too(soft_bag: Path) -> None:
    estimate = estimate_from_bag(soft_bag, START, ["actuator.turns"])
    truth = truth_of(SOFT)
    for name, found in estimate.parameters.items():
        assert found.low <= truth[name] * (1 + 1e-9) and truth[name] <= found.high * (1 + 1e-9), name
        if name in WITHIN:
            assert found.value == pytest.approx(truth[name], rel=WITHIN[name]), name
    assert estimate.advice == {}
    assert estimate.path.delay == pytest.approx(250e-6, abs=5e-6)
    assert "stage.platform.mass: 4." in parameter_file(estimate)


@pytest.mark.soak
def test_a_stroke_along_the_guide_says_what_it_does_not_tell(guide_bag: Path) -> None:
    estimate = estimate_from_bag(guide_bag, START, ["actuator.turns"])
    truth, found = truth_of(STIFF), estimate.parameters
    for name in found:
        # The interval of what this motion hardly tells is itself no more than a guess: it must be said to be poor.
        inside = found[name].low <= truth[name] * (1 + 1e-9) and truth[name] <= found[name].high * (1 + 1e-9)
        assert inside or (found[name].poor and name in estimate.advice), name
    assert not found["actuator.air_gap"].poor
    assert {"platform.mass", "friction.static", "friction.viscous"} <= set(estimate.advice)
    assert "quick motion" in estimate.advice["platform.mass"]
