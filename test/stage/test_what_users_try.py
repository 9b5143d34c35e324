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


@pytest.mark.parametrize("back", [False, True])
def test_a_survey_of_ones_own_is_followed_by_the_simulated_guide(tried, tmp_path, capsys, back):
    assert main(["stage", "new", str(tmp_path / "mine"), "--survey", survey(tmp_path, 0, 1760, back=back)]) == 0
    capsys.readouterr()
    code, figures, _ = tried("--stage", str(tmp_path / "mine" / "stage.yaml"))
    x = np.arange(0.0, 1760.0)
    guide = bend(x)
    straight = np.polyval(np.polyfit(x, guide, 1), x)
    assert code == 0 and figures["uncompensated_pp_um"] == pytest.approx(np.ptp(guide - straight), rel=0.02)
    assert figures["true_pp_um"] < 0.5


@pytest.mark.parametrize(
    ("words", "code", "most_um", "expected"),
    [
        # A survey of another guide than the simulated one; one that ends before the stroke; too long a delay.
        (
            "--set stage.guide.file=SURVEY1760",
            1,
            np.inf,
            {"verdict": "wrong_guide", "reason": "use a survey of this guide"},
        ),
        (
            "--set stage.guide.file=SURVEY600",
            1,
            np.inf,
            {"verdict": "left_map", "reason": "1760 mm; allowed: -20 mm to 620 mm; survey the whole guide"},
        ),
        ("--delay 5", 1, np.inf, {"verdict": "oscillates", "reason": " Hz"}),
        ("--set stage.platform.mass=8", 0, 0.3, {"verdict": "in_order"}),
        (
            "--set stage.motion.speed=1.0 --set stage.motion.acceleration=5.0 --set stage.motion.highest_speed=2.5",
            0,
            0.35,
            {"verdict": "in_order"},
        ),
    ],
)
def test_what_is_no_success_is_named_and_a_stage_of_another_mass_or_speed_is_compensated_as_shipped(
    tried, tmp_path, words, code, most_um, expected
):
    for stop in (600, 1760):
        if f"SURVEY{stop}" in words:
            words = words.replace(f"SURVEY{stop}", survey(tmp_path, 0, stop))
    found, figures, said = tried(*words.split())
    assert found == code and figures["true_pp_um"] < most_um
    for key, text in expected.items():
        assert all(one in figures[key] for one in text.split("; ")), figures[key]
    if "mass" in words:
        assert (figures["missing_margin"], said) == (None, "")


def test_half_the_rate_is_refused_by_the_controller_and_the_simulation_says_so(tried):
    code, figures, said = tried("--set", "stage.rate=1000")
    assert code == 0 and figures["verdict"] == "in_order"
    assert "at 1000 Hz" in figures["missing_margin"] and "straightcomp design" in figures["missing_margin"]
    assert figures["missing_margin"] in " ".join(said.split())
