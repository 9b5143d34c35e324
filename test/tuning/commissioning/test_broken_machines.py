"""Broken machines are found, each by its name: none is tuned around, none passes, and none is left with current."""

import dataclasses
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import broken
import numpy as np
import pytest
from roughly_known import ROUGH, values_of, work_on

from straightcomp_ros.cli.main import main
from straightcomp_ros.control.excitation_parameters import MultisineParameters
from straightcomp_ros.hardware.interface import Hardware, State
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from straightcomp_ros.straightness.survey import Run, Survey, read_survey, write_survey
from straightcomp_ros.straightness.survey_check import LEAST_POINTS, WIDEST_GAP
from straightcomp_ros.tuning.commissioning import machine
from straightcomp_ros.tuning.commissioning.acceptance import acceptance
from straightcomp_ros.tuning.commissioning.machine import SimulatedMachine, sound
from straightcomp_ros.tuning.commissioning.step import Outcome
from straightcomp_ros.tuning.frequency_response.measured_response import ComparedResponse

Wiring = Callable[[SimulatedHardware], Hardware]
TRUTH = "driver.simulated.truth."
WELL_KNOWN = {f"stage.uncertainty.{name}": value for name, value in {"mass": 0.2, "force": 0.2, "air_gap": 0.1}.items()}


@pytest.fixture
def commissioned(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path):
    """Commission a machine by the command; the step that did not pass, and its sentence.

    Fails if all pass, if current is left anywhere, or if there is a certificate.
    """

    def run(
        settings: Mapping[str, object],
        wiring: Wiring = sound,
        machine: type[SimulatedMachine] = SimulatedMachine,
        *options: str,
    ) -> tuple[str, str]:
        built: list[Hardware] = []

        def kept(hardware: SimulatedHardware) -> Hardware:
            built.append(wiring(hardware))
            return built[-1]

        monkeypatch.setattr(machine, "SimulatedMachine", lambda values: machine(values, kept))
        told = [word for name, value in settings.items() for word in ("--set", f"{name}={value}")]
        few = ("--evaluations", "40", "--machines", "20", "--json")
        folder = tmp_path / "done"
        assert main(["commission", str(ROUGH), "-o", str(folder), *told, *few, *options]) == 1
        found = json.loads(capsys.readouterr().out)
        assert built and all(one.state is State.OFF and one.applied_current == 0.0 for one in built)
        assert found["remaining"][0] == found["failed"] and found["remaining"][-1] == "certificate"
        assert not (folder / "certificate.html").exists() and not (folder / "tuned.yaml").exists()
        return found["failed"], found["steps"][found["failed"]]["sentence"]

    return run


@pytest.mark.parametrize(
    ("machine", "wiring", "step", "words"),
    [
        ({}, broken.lossy_bus, "connection", "of 60000 samples (1 %) were lost; look at the bus"),
        ({}, broken.noisy_encoder, "connection", "y moves by 5 counts RMS with the amplifier off"),
        ({}, broken.readback_backwards, "signs_and_scales", "the readback is wired backwards"),
        ({}, broken.readback_of_half_the_scale, "signs_and_scales", "the readback shows 0.5 times the commanded"),
        ({}, broken.encoder_backwards, "signs_and_scales", "the coils or the encoder of y are wired backwards"),
        ({}, broken.encoder_dead, "signs_and_scales", "an encoder of y that does not count"),
        ({}, broken.OneCoilDead, "signs_and_scales", "the magnets do not balance; look for a coil without current"),
        ({f"{TRUTH}amplifier": 0.1}, sound, "signs_and_scales", "the amplifier has 50 Hz, 0.1 times"),
        ({"driver.stage.drive.delay": 3.0}, sound, "signs_and_scales", "commands act 3.00 samples after theirs"),
    ],
    ids=[
        "a bus that loses one frame in a hundred",
        "an encoder of ten times the noise",
        "readback wired backwards",
        "readback of half the scale",
        "sign of y reversed",
        "encoder dead",
        "one coil dead",
        "amplifier of a tenth of the bandwidth",
        "three times the delay",
    ],
)
def test_it_is_named_before_a_loop_is_closed(
    commissioned, machine: dict[str, float], wiring: Wiring, step: str, words: str
) -> None:
    found, sentence = commissioned(machine, wiring)
    assert found == step and words in sentence


@pytest.mark.soak
@pytest.mark.parametrize(
    ("machine", "wiring", "words"),
    [
        ({}, broken.encoder_of_twice_the_count, "the count of the encoder of y"),
        ({f"{TRUTH}friction": 10.0}, sound, "friction is"),
        ({**WELL_KNOWN, f"{TRUTH}mass": 0.5}, sound, "look whether the platform is loose"),
    ],
    ids=["encoder of twice the count", "ten times the friction", "half the mass"],
)
def test_it_is_named_as_soon_as_a_loop_is_closed(
    commissioned, machine: dict[str, float], wiring: Wiring, words: str
) -> None:
    found, sentence = commissioned(machine, wiring)
    assert found == "identification" and words in sentence


class LosesItsLoad(SimulatedMachine):
    """Half of the mass falls off after the identification."""

    def response(self, values: Mapping[str, Mapping[str, Any]], excitation: MultisineParameters) -> ComparedResponse:
        whole = self.parameters
        self.parameters = {**whole, "simulated.truth.mass": 0.5}
        try:
            return super().response(values, excitation)
        finally:
            self.parameters = whole


@pytest.mark.soak
def test_a_platform_that_comes_loose_later_is_named_by_the_frequency_response(commissioned) -> None:
    found, sentence = commissioned({}, sound, LosesItsLoad)
    assert found == "frequency_response"
    times = re.search(r"accelerates the platform ([\d.]+) times as much as when it was identified", sentence)
    assert times and 1.7 < float(times[1]) < 2.2


def other_guide(file: Path) -> str:
    """A survey of another guide of the same length and height."""
    x = np.linspace(0.0, 1.76, 177)
    write_survey(file, Survey((Run("1", "forward", x, 1e-5 * np.sin(7.0 * x)),)))
    return str(file)


def check_of(guide: str, file: Path) -> Survey:
    """A check survey of ``guide``, out and back at 15 places, as a straightedge would give it."""
    true, random = load_map(MapParameters(file=guide)), np.random.default_rng(1)
    x = np.linspace(true.span[0] + 0.02, true.span[1] - 0.02, 15)
    runs = tuple(
        Run("1", direction, x, true.deviations(x) + 4e-6 * x + 5e-8 * random.standard_normal(x.size))
        for direction in ("forward", "backward")
    )
    write_survey(file, Survey(runs))
    return read_survey(file, min_points=LEAST_POINTS, max_gap=WIDEST_GAP)


def accepted(folder: Path, guide: str, check: Survey | None) -> Outcome:
    """The step on a machine as described, but for its guide."""
    values = values_of({"simulated.truth.guide": guide})
    return acceptance(dataclasses.replace(work_on(values, folder), check_survey=check))


def test_the_wrong_survey_is_found_by_a_check_of_the_guide(tmp_path: Path) -> None:
    guide = other_guide(tmp_path / "other.csv")
    outcome = accepted(tmp_path, guide, check_of(guide, tmp_path / "check.csv"))
    assert not outcome.passed and "the survey is not that of the guide: they differ by" in outcome.sentence
    assert not (tmp_path / "limits.yaml").exists()


def test_a_survey_that_is_right_agrees_with_the_check(tmp_path: Path) -> None:
    right = "config/guide_synthetic.csv"
    outcome = accepted(tmp_path, right, check_of(right, tmp_path / "check.csv"))
    assert outcome.passed and "the survey agrees with the check" in outcome.sentence
    assert outcome.figures["survey_agrees"] is True and outcome.figures["survey_check_points"] == 15


def test_without_a_check_the_stroke_alone_does_not_tell_the_wrong_survey_and_the_step_says_so(tmp_path: Path) -> None:
    outcome = accepted(tmp_path, other_guide(tmp_path / "other.csv"), None)
    assert outcome.passed and "the survey of the guide was not verified" in outcome.sentence


@pytest.mark.soak
def test_the_wrong_survey_ends_the_command_at_the_acceptance(commissioned, tmp_path: Path) -> None:
    guide = other_guide(tmp_path / "other.csv")
    check_of(guide, tmp_path / "check.csv")
    settings, options = {f"{TRUTH}guide": guide}, ("--check-survey", str(tmp_path / "check.csv"))
    found, sentence = commissioned(settings, sound, SimulatedMachine, *options)
    assert found == "acceptance" and "the survey is not that of the guide" in sentence
