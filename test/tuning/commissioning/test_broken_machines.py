"""Whole commissions of broken machines: each is named, none is tuned around, and none is left with current."""

import json
import re

import broken
import pytest
from roughly_known import ROUGH

from straightcomp_ros.cli.main import main
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.tuning.commissioning import machine as machines
from straightcomp_ros.tuning.commissioning.machine import SimulatedMachine, sound

pytestmark = pytest.mark.nightly

TRUTH = "driver.simulated.truth."
WELL_KNOWN = {f"stage.uncertainty.{name}": value for name, value in {"mass": 0.2, "force": 0.2, "air_gap": 0.1}.items()}


@pytest.fixture
def commissioned(monkeypatch, capsys, tmp_path):
    """Commission a machine by the command; the step that did not pass, and its sentence.

    Fails if all pass, if current is left anywhere, or if there is a certificate.
    """

    def run(settings, wiring=sound, machine=SimulatedMachine, *options):
        built = []

        def kept(hardware):
            built.append(wiring(hardware))
            return built[-1]

        monkeypatch.setattr(machines, "SimulatedMachine", lambda values: machine(values, kept))
        words = [word for name, value in settings.items() for word in ("--set", f"{name}={value}")]
        few = ("--evaluations", "40", "--machines", "20", "--json")
        folder = tmp_path / "done"
        assert main(["commission", str(ROUGH), "-o", str(folder), *words, *few, *options]) == 1
        found = json.loads(capsys.readouterr().out)
        assert built and all(one.state is State.OFF and one.applied_current == 0.0 for one in built)
        assert found["remaining"][0] == found["failed"] and found["remaining"][-1] == "certificate"
        assert not (folder / "certificate.html").exists() and not (folder / "tuned.yaml").exists()
        return found["failed"], found["steps"][found["failed"]]["sentence"]

    return run


@pytest.mark.parametrize(
    ("settings", "wiring", "step", "words"),
    [
        # `test_open_loop.py` has all that these two steps name.
        ({}, broken.lossy_bus, "connection", "of 60000 samples (1 %) were lost"),
        ({}, broken.one_coil_dead, "signs_and_scales", "the magnets do not balance; look for a coil without current"),
        ({}, broken.encoder_of_twice_the_count, "identification", "the count of the encoder"),
        ({f"{TRUTH}friction": 10.0}, sound, "identification", "friction is"),
        ({**WELL_KNOWN, f"{TRUTH}mass": 0.5}, sound, "identification", "look whether the platform is loose"),
    ],
    ids=["lossy bus", "one coil dead", "twice the count", "ten times the friction", "half the mass"],
)
def test_it_is_named_at_the_first_step_that_can_see_it(commissioned, settings, wiring, step, words):
    found, sentence = commissioned(settings, wiring)
    assert found == step and words in sentence


class LosesItsLoad(SimulatedMachine):
    """Half of the mass falls off after the identification."""

    def response(self, values, excitation):
        whole = self.parameters
        self.parameters = {**whole, "simulated.truth.mass": 0.5}
        try:
            return super().response(values, excitation)
        finally:
            self.parameters = whole


def test_a_platform_that_comes_loose_later_is_named_by_the_frequency_response(commissioned):
    found, sentence = commissioned({}, sound, LosesItsLoad)
    assert found == "frequency_response"
    times = re.search(r"accelerates the platform ([\d.]+) times as much as when it was identified", sentence)
    assert times and 1.7 < float(times[1]) < 2.2
