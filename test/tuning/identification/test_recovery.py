"""The truth lies in the intervals, and the intervals are as narrow as they should be, or said to be wide."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from plants import FAR, SOFT, STIFF, record, values

from straightcomp_ros.analysis.current_path import CurrentPath, read_recording
from straightcomp_ros.model.actuator import ActuatorParameters
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.identification.estimate import (
    DERIVED,
    UNITS,
    Estimate,
    Estimated,
    estimate_from_bag,
    parameter_file,
)
from straightcomp_ros.tuning.identification.unknowns import NAMES, centre, sliding_start, unknowns

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


def truth_of(plant):
    whole = {**to_mapping(START), **plant}
    magnets = ActuatorParameters(
        **{name.partition(".")[2]: whole[name] for name in whole if name.startswith("actuator.")}
    )
    return {**whole, **{name: getattr(magnets, name.removeprefix("actuator.")) for name in DERIVED}}


def is_within(found, truth):
    return found.low <= truth * (1 + 1e-9) and truth <= found.high * (1 + 1e-9)


def assert_found(parameters, plant):
    """All are within their intervals, and within the stated bounds."""
    truth = truth_of(plant)
    for name, found in parameters.items():
        assert is_within(found, truth[name]), name
        if name in WITHIN:
            assert found.value == pytest.approx(truth[name], rel=WITHIN[name]), name


def test_an_excited_plant_is_found_within_its_intervals_and_within_stated_bounds(stiff_answer):
    answer, _ = stiff_answer
    assert_found({name: SimpleNamespace(**found) for name, found in answer["parameters"].items()}, STIFF)
    assert not any(found["poorly_determined"] for found in answer["parameters"].values())


@pytest.mark.nightly
def test_another_plant_under_another_law_is_found_too(soft_bag):
    estimate = estimate_from_bag(soft_bag, START, ["actuator.turns"])
    assert_found(estimate.parameters, SOFT)
    assert estimate.advice == {}
    assert estimate.path.delay == pytest.approx(250e-6, abs=5e-6)
    assert "stage.platform.mass: 4." in parameter_file(estimate)


@pytest.mark.nightly
def test_a_coarse_encoder_leaves_the_forces_less_certain_than_a_fine_one(tmp_path, excitation):
    widths, truth = {}, truth_of(STIFF)
    # STIFF has its own mass, and the description's is taken as known: what is compared is relative to it.
    scale = START.platform.mass / truth["platform.mass"]
    for count in (5e-8, 4e-7):
        parameters = values(STIFF, guide_file=excitation)
        parameters["stage"]["encoder.y_resolution"] = count
        start = dataclasses.replace(START, encoder=dataclasses.replace(START.encoder, y_resolution=count))
        found = estimate_from_bag(record(tmp_path / f"{count}", parameters), start, ["platform.mass"]).parameters
        widths[count] = found["actuator.turns"].high / found["actuator.turns"].value - 1.0
        for name in ("friction.coulomb", "actuator.current_stiffness"):
            assert found[name].low <= truth[name] * scale <= found[name].high, name
    assert widths[4e-7] > 3.0 * widths[5e-8]


@pytest.mark.nightly
def test_a_stroke_along_the_guide_says_what_it_cannot_identify(guide_bag):
    estimate = estimate_from_bag(guide_bag, START, ["actuator.turns"])
    truth, parameters = truth_of(STIFF), estimate.parameters
    for name, found in parameters.items():
        # The interval of what this motion hardly identifies is itself no more than a guess: it must be said to be poor.
        assert is_within(found, truth[name]) or (found.poor and name in estimate.advice), name
    assert not parameters["actuator.air_gap"].poor
    assert {"platform.mass", "friction.static", "friction.viscous"} <= set(estimate.advice)
    assert "quick motion" in estimate.advice["platform.mass"]


def test_sliding_alone_leads_near_the_machine_whatever_the_description_says_if_there_is_enough_of_it(far_bag):
    begin, recording = unknowns(START, ["platform.mass"]), read_recording(far_bag)
    slid = sliding_start(recording, begin)
    assert slid is not None
    ratio = START.platform.mass / FAR["platform.mass"]
    found, truth = dict(zip(NAMES, np.exp(slid).tolist(), strict=True)), truth_of(FAR)
    assert found["platform.mass"] == pytest.approx(START.platform.mass)
    assert found["actuator.air_gap"] == pytest.approx(truth["actuator.air_gap"], rel=0.01)
    assert found["actuator.turns"] ** 2 == pytest.approx(truth["actuator.turns"] ** 2 * ratio, rel=0.1)
    assert found["friction.coulomb"] == pytest.approx(truth["friction.coulomb"] * ratio, rel=0.1)
    assert found["friction.bristle_stiffness"] == pytest.approx(START.friction.bristle_stiffness)
    assert sliding_start(dataclasses.replace(recording, y=0.01 * recording.y), begin) is None


@pytest.mark.nightly
def test_a_machine_far_from_its_description_is_found_up_to_the_scale_of_forces(far_bag):
    estimate = estimate_from_bag(far_bag, dataclasses.replace(START, drive=DriveParameters()), ["platform.mass"])
    ratio = START.platform.mass / FAR["platform.mass"]
    truth, found = truth_of(FAR), estimate.parameters
    assert found["actuator.air_gap"].value == pytest.approx(truth["actuator.air_gap"], rel=0.005)
    for name in ("actuator.current_stiffness", "actuator.position_stiffness", "friction.coulomb"):
        assert found[name].value == pytest.approx(truth[name] * ratio, rel=0.01), name
    assert estimate.path.rate == pytest.approx(2.0 * math.pi * FAR["drive.bandwidth"], rel=1e-3)
    assert estimate.path.delay == pytest.approx(FAR["drive.delay"] / START.rate, rel=1e-3)
    assert "platform.mass was given" in estimate.not_identifiable[0]


def test_what_the_record_leaves_open_is_said_in_sentences():
    parameters = {name: Estimated(name, 1.0, 0.99, 1.01, name == "platform.mass") for name in UNITS}
    parameters["friction.viscous"] = Estimated("friction.viscous", 1.0, 0.5, 2.0, False, ("friction.static",))
    parameters["friction.static"] = Estimated("friction.static", 1.0, 0.9, 1.1, False, ("friction.viscous",))
    path = CurrentPath(1.0, None, None, None, 1e-4, False, 0.0, (1e-4, 1e-4))
    sentences = Estimate(parameters, None, path, None).not_identifiable
    assert "platform.mass was given" in sentences[0] and "actuator.turns" not in sentences[0]
    assert "bandwidth" in sentences[1]
    assert sum("told apart" in sentence for sentence in sentences) == 1
    assert "friction.viscous is only known to lie between 0.5 and 2 N·s/m." in sentences
    assert len(sentences) == 4


SHIFT = 25e-6
"""m; of the zero of an encoder of y off the magnets' centre."""


def shifted(hardware):
    read = hardware.read
    hardware.read = lambda now_ns: [(one._replace(y=one.y + SHIFT), truth) for one, truth in read(now_ns)]
    return hardware


@pytest.fixture
def shifted_bag(tmp_path, excitation):
    return record(tmp_path / "bag", values(STIFF, guide_file=excitation), wiring=shifted)


def test_a_centre_of_the_magnets_off_the_encoders_zero_is_found(shifted_bag, stiff_bag):
    aligned, off = centre(read_recording(stiff_bag)), centre(read_recording(shifted_bag))
    assert aligned is not None and not aligned.certain and abs(aligned.value) < 0.1e-6
    assert off is not None and off.certain and off.value == pytest.approx(SHIFT, abs=0.1e-6)


@pytest.mark.nightly
def test_a_centre_of_the_magnets_off_the_encoders_zero_harms_no_other_fact(shifted_bag):
    found = estimate_from_bag(shifted_bag, START, ["actuator.turns"])
    for name in ("platform.mass", "actuator.air_gap", "friction.coulomb"):
        assert found.parameters[name].value == pytest.approx(truth_of(STIFF)[name], rel=WITHIN[name]), name
