"""What a user does first with a stage of his own ends well, or with a sentence and exit code 1."""

import json

import numpy as np
import pytest

from straightcomp_ros.cli.main import main

SEED = 4


def bend(x):
    """Deviation of the user's guide in µm at x in mm."""
    return 10.0 * np.sin(2.0 * np.pi * x / 1500.0)


def survey(folder, start, stop, *, back=False):
    """A survey of a guide of some 20 µm, in mm and µm; with ``back`` forth and back in one column."""
    x = np.arange(start, stop + 1e-9, 10.0)
    x = np.concatenate([x, x[::-1]]) if back else x
    read = bend(x) + 0.02 * np.random.default_rng(SEED).standard_normal(x.size)
    file = folder / "survey.csv"
    np.savetxt(file, np.column_stack([x, read]), "%.4f", ",", header="x_mm,deviation_um", comments="")
    return str(file)


@pytest.fixture
def tried(capsys):
    """Runs `straightcomp simulate --json` with these words; returns exit code, figures, standard error."""

    def simulate(*words):
        code = main(["simulate", "--json", *words])
        printed = capsys.readouterr()
        return code, json.loads(printed.out), printed.err

    return simulate


@pytest.fixture
def described(tmp_path, capsys):
    """Makes a stage file for a survey, as the README says; returns its name."""

    def new(file):
        assert main(["stage", "new", str(tmp_path / "mine"), "--survey", file]) == 0
        capsys.readouterr()
        return str(next((tmp_path / "mine").glob("*.yaml")))

    return new


@pytest.mark.parametrize("back", [False, True])
def test_a_survey_of_ones_own_is_followed_by_the_simulated_guide(tried, described, tmp_path, back):
    code, figures, _ = tried("--stage", described(survey(tmp_path, 0, 1760, back=back)))
    x = np.arange(0.0, 1760.0)
    guide = bend(x)
    straight = np.polyval(np.polyfit(x, guide, 1), x)
    assert code == 0 and figures["uncompensated_pp_um"] == pytest.approx(np.ptp(guide - straight), rel=0.02)
    assert figures["true_pp_um"] < 0.5


def test_a_survey_of_another_guide_than_the_simulated_one_is_named_and_no_success(tried, tmp_path):
    code, figures, _ = tried("--set", f"stage.guide.file={survey(tmp_path, 0, 1760)}")
    assert code == 1 and figures["verdict"] == "wrong_guide" and "use a survey of this guide" in figures["reason"]


def test_a_survey_that_ends_before_the_stroke_is_named_and_no_success(tried, tmp_path):
    code, figures, _ = tried("--set", f"stage.guide.file={survey(tmp_path, 0, 600)}")
    assert code == 1 and figures["verdict"] == "left_map"
    assert "1760 mm; allowed: -20 mm to 620 mm" in figures["reason"] and "survey the whole guide" in figures["reason"]


def test_another_mass_needs_no_other_gains(tried):
    code, figures, said = tried("--set", "stage.platform.mass=8")
    assert (code, figures["missing_margin"], said) == (0, None, "")
    assert figures["true_pp_um"] < 0.3


def test_half_the_rate_is_refused_by_the_controller_and_the_simulation_says_so(tried):
    code, figures, said = tried("--set", "stage.rate=1000")
    assert code == 0 and figures["verdict"] == "in_order"
    assert "at 1000 Hz" in figures["missing_margin"] and "straightcomp design" in figures["missing_margin"]
    assert figures["missing_margin"] in " ".join(said.split())


def test_a_delay_that_no_gains_bear_oscillates_and_is_no_success(tried):
    code, figures, _ = tried("--delay", "5")
    assert code == 1 and figures["verdict"] == "oscillates" and "Hz" in figures["reason"]


def test_a_fast_stage_is_compensated_as_it_is_shipped(tried):
    words = ("stage.motion.speed=1.0", "stage.motion.acceleration=5.0", "stage.motion.highest_speed=2.5")
    code, figures, _ = tried(*(word for one in words for word in ("--set", one)))
    assert code == 0 and figures["true_pp_um"] < 0.35
