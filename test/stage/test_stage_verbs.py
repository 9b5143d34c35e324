"""`straightcomp stage`: a description is written, checked, shown with what follows from it, and run by `simulate`."""

from unittest.mock import Mock

import numpy as np
import pytest
import yaml

from straightcomp_ros.parameters.declaration import declarations, from_mapping, to_mapping
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.stage.description import StageParameters

SHORT = ["--set", "motion.speed=0.1", "--set", "motion.acceleration=0.5"]


def bend(x):
    """Deviation of the user's guide in µm at x in mm."""
    return 10.0 * np.sin(2.0 * np.pi * x / 1500.0)


@pytest.fixture
def survey(tmp_path):
    """``survey(start, stop)`` is the file of a survey of that guide; with ``back`` forth and back in one column, in
    another ``unit`` in µm."""

    def surveyed(start, stop, step=10.0, *, back=False, unit=1.0):
        x = np.arange(start, stop + 1e-9, step)
        x = np.concatenate([x, x[::-1]]) if back else x
        read = (bend(x) + 0.02 * np.random.default_rng(4).standard_normal(x.size)) / unit
        file = tmp_path / "measured.csv"
        np.savetxt(file, np.column_stack([x, read]), "%.6f", ",", header="x_mm,deviation_um", comments="")
        return file

    return surveyed


@pytest.fixture
def new(verb):
    """``new(folder, …)`` runs `straightcomp stage new`."""
    return lambda folder, *options: verb("stage", "new", folder, "--yes", *options)


@pytest.mark.parametrize("given", ["--survey=measured.csv", "--set=stage.guide.file=measured.csv"])
def test_a_new_stage_has_the_strokes_of_its_survey_and_what_was_given(tmp_path, new, survey, monkeypatch, given):
    folder, file = tmp_path / "gantry", survey(100, 700)
    monkeypatch.chdir(tmp_path)
    said = new(folder, given, "--set", "platform.mass=8", "--set", "friction.bristle_stiffness=2e6")
    assert said.code == 0 and "synthetic" not in said.out
    stage = from_mapping(StageParameters, shipped_parameters(stage=folder / "stage.yaml")["stage"])
    assert (stage.name, stage.platform.mass, stage.friction.bristle_stiffness) == ("gantry", 8.0, 2e6)
    assert (stage.motion.start, stage.motion.stroke) == pytest.approx((0.1, 0.6))
    assert stage.guide.file == str(folder / "survey.csv")
    assert (folder / "survey.csv").read_bytes() == file.read_bytes()


@pytest.mark.parametrize("name", ["Bench 3, left gantry, axis X, " * 5 + "since May", "two\\nlines: ["])
def test_a_new_stage_has_the_name_that_was_given_however_long(tmp_path, new, name):
    assert new(tmp_path / "one", "--set", f'name="{name}"').code == 0
    assert shipped_parameters(stage=tmp_path / "one" / "stage.yaml")["stage"]["name"] == name.replace("\\n", "\n")


def test_the_survey_of_a_new_stage_may_have_the_gaps_that_are_given(tmp_path, new, survey):
    file = survey(0.0, 1800.0, step=60.0)
    refused = new(tmp_path / "one", "--survey", file)
    assert refused.code == 2 and "allowed: <= 50 mm" in refused.err
    assert new(tmp_path / "one", "--survey", file, "--set", "stage.guide.max_gap=0.1").code == 0


def test_a_new_description_has_each_fact_once_with_its_meaning_and_is_kept_unless_it_is_forced(tmp_path, new):
    assert new(tmp_path / "one").code == 0
    text = (tmp_path / "one" / "stage.yaml").read_text()
    declared = list(declarations(StageParameters, "stage."))
    assert list(yaml.safe_load(text)["/**"]["ros__parameters"]) == [one.name for one in declared]
    assert all(one.description in text for one in declared)
    refused = new(tmp_path / "one", "--set", "platform.mass=8")
    assert refused.code == 2 and "--force" in refused.err
    assert (tmp_path / "one" / "stage.yaml").read_text() == text
    assert new(tmp_path / "one", "--set", "platform.mass=8", "--force").code == 0


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("platform.mass=-1", "'platform.mass': -1.0 kg is too small; allowed: >= 1e-06"),
        ("platform.mas=1", "did you mean 'platform.mass'"),
        ("platform.mass", "NAME=VALUE"),
        ("motion.speed=1.9", "'motion.highest_speed': 2.0 m/s is too near the cruising speed; allowed: >= 2.85 m/s"),
        ("actuator.air_gap=0.001", "'platform.stop': 0.0012 m is not inside the air gap"),
    ],
)
def test_what_no_stage_has_is_refused_before_anything_is_written(tmp_path, new, given, words):
    refused = new(tmp_path / "one", "--set", given)
    assert refused.code == 2 and words in refused.err
    assert new(tmp_path / "one", "--survey", "nowhere.csv").code == 2
    assert new(tmp_path / "one\ttwo").code == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("answers", "facts"),
    [
        (
            {"Air gap": ["0.001"], "Mechanical stop": ["", "0.0008"]},
            {"actuator.air_gap": 1e-3, "platform.stop": 8e-4},
        ),
        ({"Samples": ["fast", "4000"]}, {"rate": 4000}),
        ({"Cruising speed": ["1.5"], "Speed that": ["2.5"]}, {"motion.speed": 1.5, "motion.highest_speed": 2.5}),
        (
            {"Samples": ["4000"], "Coulomb friction": ["2.0"], "Static friction": ["", "2.5"]},
            {"rate": 4000, "friction.coulomb": 2.0, "friction.static": 2.5},
        ),
        # The answer that was typed wrong is the one that the refusal compares with.
        ({"Coulomb friction": ["43", "0.4"]}, {"friction.coulomb": 0.4}),
        (
            {"Turns": ["100000", "500"], "Bias current": ["2"]},
            {"actuator.turns": 500.0, "actuator.bias_current": 2.0},
        ),
    ],
)
def test_on_a_terminal_what_was_not_given_is_asked_for_until_it_fits_the_other_answers_and_they_are_kept(
    tmp_path, monkeypatch, verb, answers, facts
):
    left = {words: iter(texts) for words, texts in answers.items()}
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr(
        "builtins.input",
        lambda question: next((next(texts, "") for words, texts in left.items() if words in question), ""),
    )
    said = verb("stage", "new", tmp_path / "my stage", "--set", "platform.mass=4")
    assert said.code == 0 and f"facts given: {len(facts) + 1};" in said.out.replace("\n", " ")
    assert said.err.endswith(f"next: straightcomp stage check '{tmp_path}/my stage/stage.yaml'\n")
    written = shipped_parameters(stage=tmp_path / "my stage" / "stage.yaml")["stage"]
    own = {"platform.mass": 4.0, "name": "my stage", "guide.file": written["guide.file"]}
    assert written == to_mapping(StageParameters()) | own | facts
    # What cannot be is answered by the reason.
    assert ("'fast' Hz is not an integer" in said.out) == ("fast" in answers.get("Samples", ()))


@pytest.mark.parametrize("name", ["one", "one/deep/er"])
@pytest.mark.parametrize("there", [False, True])
def test_questions_that_are_not_answered_leave_no_folder_but_one_that_was_there(
    tmp_path, monkeypatch, verb, there, name
):
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", Mock(side_effect=["4000", EOFError]))
    if there:
        (tmp_path / "one").mkdir()
    assert verb("stage", "new", tmp_path / name).code == 2
    assert (tmp_path / "one").exists() is there and not list(tmp_path.glob("one/*"))


@pytest.mark.parametrize(("stroke", "worst"), [(1.76, "ok"), (1.77, "warn"), (2.0, "fail")])
def test_a_check_fails_exactly_where_a_finding_does_and_a_new_stage_has_none(tmp_path, new, verb, stroke, worst):
    assert new(tmp_path / "one", *([] if worst == "ok" else [f"--set=motion.stroke={stroke}"])).code == 0
    found = verb("stage", "check", tmp_path / "one" / "stage.yaml", "--json")
    states = {check["state"] for check in found.json["checks"]}
    assert worst in states and (worst != "ok" or states == {"ok"})
    assert found.code == (1 if found.json["fail"] else 0) == (1 if "fail" in states else 0)


def test_rates_of_two_nodes_that_differ_are_refused_as_by_a_simulation(tmp_path, verb):
    file = tmp_path / "stage.yaml"
    file.write_text("/**:\n  ros__parameters: {stage.rate: 2000}\ndriver:\n  ros__parameters: {stage.rate: 1000}\n")
    for words in (("stage", "check"), ("simulate", "--stage")):
        found = verb(*words, file)
        assert found.code == 2 and "'stage.rate': 2000 Hz; allowed: 1000 Hz" in found.err


def test_a_survey_that_is_nowhere_is_refused_with_the_folder_of_the_stage_file(tmp_path, verb):
    (tmp_path / "stage.yaml").write_text("/**:\n  ros__parameters:\n    stage.guide.file: nowhere.csv\n")
    for plot in ([], ["--plot", tmp_path / "map.pdf"]):
        found = verb("stage", "check", tmp_path / "stage.yaml", *plot, "--json")
        assert (found.code, found.err) == (1, "") and not (tmp_path / "map.pdf").exists()
        assert found.json["checks"][0]["detail"] == f"survey {tmp_path}/nowhere.csv: there is no such file"


def test_a_survey_whose_unit_is_wrong_is_found(tmp_path, new, survey, verb):
    assert new(tmp_path / "one", "--survey", survey(100, 700, unit=100.0)).code == 0
    found = verb("stage", "check", tmp_path / "one" / "stage.yaml", "--json").json
    (check,) = (one for one in found["checks"] if one["name"] == "correction")
    assert check["state"] == "warn" and "unit of the survey" in check["remedy"]


def test_what_follows_from_a_stage_is_what_the_equations_say(tmp_path, new, verb):
    assert new(tmp_path / "one").code == 0
    stage = tmp_path / "one" / "stage.yaml"
    shown = verb("stage", "show", stage, "--json")
    found = shown.json
    # (3): K̄_i = μ0 N² A I0 / y0², K̄_y = K̄_i I0 / y0; two significant digits of docs/evidence/plant.md.
    assert shown.code == 0 and found["current_stiffness_N_per_A"] == pytest.approx(44.68, abs=0.01)
    assert found["position_stiffness_N_per_m"] == pytest.approx(44.68 / 1.5e-3, rel=1e-3)
    assert found["dead_time_ms"] == pytest.approx(0.75 + 1e3 / (2 * 3.14159 * 500), rel=1e-4)
    assert found["dac_force_mN"] == pytest.approx(44.68 * 2.0 / 4.096, rel=1e-3)
    assert found["correction_um"] == pytest.approx(11.2, abs=0.1)
    assert found["phase_deg"] > 10.0
    assert "dead time" in verb("stage", "show", stage).out
    stage.write_text(stage.read_text() + "/**/controller: {ros__parameters: {control: {law: open_loop}}}\n")
    found = verb("stage", "show", stage, "--json").json
    assert (found["law"], found["phase_deg"], found["longest_delay_s"]) == ("open_loop", None, None)


@pytest.mark.parametrize("back", [False, True])
def test_a_simulation_finds_the_survey_beside_the_stage_and_its_guide_is_the_surveyed_one(
    tmp_path, new, survey, verb, monkeypatch, back
):
    assert new(tmp_path / "mine", "--survey", survey(100, 700, back=back), *SHORT).code == 0
    monkeypatch.chdir("/")
    simulated = verb("simulate", "--stage", tmp_path / "mine" / "stage.yaml", "--json")
    found = simulated.json
    assert simulated.code == 0 and found["duration_s"] == pytest.approx(2 * (0.6 / 0.1 + 0.1 / 0.5) + 0.5, abs=0.1)
    x = np.arange(100.0, 700.0)
    straight = np.polyval(np.polyfit(x, bend(x), 1), x)
    assert found["uncompensated_pp_um"] == pytest.approx(np.ptp(bend(x) - straight), rel=0.02)
    assert found["residual_pp_um"] < 0.5 and found["true_pp_um"] < 0.5


@pytest.mark.parametrize(
    ("given", "most_um"),
    [("platform.mass=8", 0.3), ("motion.speed=1.0 motion.acceleration=5.0 motion.highest_speed=2.5", 0.35)],
)
def test_a_stage_of_another_mass_or_speed_is_compensated_as_the_shipped_one(verb, given, most_um):
    found = verb("simulate", *(f"--set=stage.{one}" for one in given.split()), "--json")
    assert (found.code, found.json["verdict"], found.err) == (0, "in_order", "")
    assert found.json["true_pp_um"] < most_um and found.json["missing_margin"] is None


def test_half_the_rate_is_refused_by_the_controller_and_the_simulation_says_so(verb):
    found = verb("simulate", "--set", "stage.rate=1000", "--json")
    missing = found.json["missing_margin"]
    assert found.code == 0 and found.json["verdict"] == "in_order"
    assert "at 1000 Hz" in missing and "straightcomp design" in missing and missing in " ".join(found.err.split())


def test_the_identity_differs_between_machines_and_not_with_their_strokes():
    shipped = StageParameters()
    assert shipped.identity == StageParameters().identity
    assert shipped.identity.startswith("synthetic ")
    assert from_mapping(StageParameters, {"platform.mass": 3.01}).identity != shipped.identity
    assert from_mapping(StageParameters, {"name": "gantry"}).identity.startswith("gantry ")
    assert from_mapping(StageParameters, {"motion.stroke": 0.2}).identity == shipped.identity
