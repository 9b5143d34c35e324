"""On simulated stages the measurement agrees with the closed form of their plant, and rejects a wrong description."""

import json
from pathlib import Path

import numpy as np
import pytest

from straightcomp_ros.cli.main import main

STAGES = Path(__file__).resolve().parents[2] / "stages"


def measured(capsys, *options, exit_code=0):
    assert main(["frequency-response", "--json", *options]) == exit_code
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--law", "linear"),
        pytest.param(("--law", "smc"), marks=pytest.mark.nightly),
        ("--stage", str(STAGES / "sticky.yaml")),
        pytest.param(("--stage", str(STAGES / "heavy_platform.yaml")), marks=pytest.mark.nightly),
        pytest.param(("--stage", str(STAGES / "rate_1_khz.yaml")), marks=pytest.mark.nightly),
    ],
    ids=["shipped", "linear", "smc", "sticky", "heavy_platform", "rate_1_khz"],
)
def test_the_plant_is_within_1_db_and_5_degrees_of_its_closed_form_wherever_it_is_coherent(capsys, options):
    answer = measured(capsys, *options)
    coherent = np.array(answer["coherence"]) > 0.9
    frequencies = np.array(answer["frequency_Hz"])
    assert np.abs(np.array(answer["deviation_dB"])[coherent]).max() < 1.0
    assert np.abs(np.array(answer["deviation_deg"])[coherent]).max() < 5.0
    assert answer["model_explains_the_plant"]
    # Against much friction slow motions drown in its reversals; all others are measured.
    assert coherent[frequencies > 15.0].all() and frequencies[0] == 2.0
    assert answer["clipped_samples"] == 0


def test_the_measured_margins_are_near_those_of_the_description(capsys):
    answer = measured(capsys, "--law", "linear")
    found, model = answer["margins"], answer["model_margins"]
    assert found["gain_high"] == pytest.approx(model["gain_high"], rel=0.05)
    assert found["gain_low"] == pytest.approx(model["gain_low"], rel=0.1)
    assert found["phase_deg"] == pytest.approx(model["phase_deg"], abs=2.0)
    assert found["delay_us"] == pytest.approx(model["delay_us"], rel=0.05)
    assert found["sensitivity_peak"] == pytest.approx(model["sensitivity_peak"], rel=0.05)


@pytest.mark.parametrize("truth", ["mass=1.4", "force=0.7", "amplifier=0.4"])
def test_a_description_that_is_wrong_is_rejected(capsys, truth):
    told = ("--law", "linear", "--draws", "8", "--set", f"driver.simulated.truth.{truth}")
    answer = measured(capsys, *told, exit_code=1)
    assert not answer["model_explains_the_plant"]


def test_a_wrong_description_is_said_to_be_wrong(capsys):
    told = ("--law", "linear", "--draws", "4", "--set", "driver.simulated.truth.mass=1.4")
    assert main(["frequency-response", *told]) == 1
    said = capsys.readouterr()
    assert "the description does not explain the plant" in " ".join(said.err.split()) and "phase margin" in said.out


def test_the_loop_is_measured_while_the_stage_makes_strokes(capsys):
    answer = measured(capsys, "--moving")
    coherent = np.array(answer["coherence"]) > 0.9
    assert np.abs(np.array(answer["deviation_dB"])[coherent]).max() < 1.0
    assert coherent[np.array(answer["frequency_Hz"]) > 10.0].all()


def test_a_platform_that_leaves_the_travel_ends_the_measurement(capsys):
    # Without feedforward the law lags behind the moving reference by more than is allowed.
    assert main(["frequency-response", "--moving", "--law", "linear", "--travel", "5e-7"]) == 1
    assert "take less current, or allow more travel" in capsys.readouterr().err


def test_plots_are_saved_and_the_table_is_printed(capsys, tmp_path):
    plot = tmp_path / "loop.svg"
    assert main(["frequency-response", "--draws", "4", "-o", str(plot)]) == 0
    said = capsys.readouterr()
    assert "phase margin" in said.out and "N·s/m" in said.err
    assert plot.read_text().startswith("<?xml")
