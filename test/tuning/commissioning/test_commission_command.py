"""The steps are done once and in their order; the command says what they found, and ends at a machine that is not as
described, with no current left."""

import itertools
import json
import re
from functools import partial
from pathlib import Path

import pytest
from roughly_known import ROUGH, encoder_of_twice_the_count, other_guide, values_of
from tiers import nightly

from straightcomp_ros.hardware.interface import State
from straightcomp_ros.offline.starts import with_values
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.output_files import MARK
from straightcomp_ros.straightness.survey import read_survey
from straightcomp_ros.tuning.commissioning import MADE, RECORD, STEP_FILES, CommissionRefused, procedure
from straightcomp_ros.tuning.commissioning import machine as machines
from straightcomp_ros.tuning.commissioning.closed_loop import STAYS_OPEN
from straightcomp_ros.tuning.commissioning.machine import Outcome, SimulatedMachine
from straightcomp_ros.tuning.commissioning.procedure import STEPS, Procedure


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "done"


@pytest.fixture
def commission(verb, folder):
    """Runs `straightcomp commission` of the rough stage, in ``folder``."""
    return partial(verb, "commission", ROUGH, "-o", folder)


def test_a_step_alone_is_done_and_a_later_one_is_refused(commission):
    code, out, err = commission("--only", "connection")
    assert code == 0 and "connection: 60000 samples at 2000 Hz, none lost" in " ".join(out.split())
    assert "next: the same command without --only does the steps that are left: signs_and_scales" in err
    code, _, said = commission("--only", "design")
    assert code == 2 and "rests on 'signs_and_scales', which has not passed" in said


def test_what_an_acceptance_that_has_passed_cannot_heed_any_more_is_refused(done, tmp_path, commission):
    check = tmp_path / "check.csv"
    rows = [f"{run},{place},{0.01 * place + 0.1 * run}" for run in (1, 2) for place in range(0, 601, 100)]
    check.write_text("\n".join(["run,x_mm,deviation_um", *rows]) + "\n")

    def refuses(*asked):
        code, _, said = commission(*asked)
        return code == 2 and f"{asked[0]}: step 'acceptance' has passed without it; --only acceptance" in said

    # Passed without a survey, and without learning; nothing is left to do.
    assert commission().code == 0
    assert refuses("--check-survey", check) and refuses("--learn", 3)
    # The command that was interrupted after its acceptance goes on, wherever its files are now.
    figures = {"survey_check_sha256": read_survey(check, max_gap=1.0, min_points=4).digest, "learning_strokes": 3}
    done["acceptance"] = lambda work: Outcome(True, "passed", figures, gains={"learning.learn": True})
    assert commission("--only", "acceptance").code == commission().code == 0
    code, _, said = commission("--check-survey", check.rename(tmp_path / "moved.csv"), "--learn", 3)
    assert code == 0 and "next: all is done" in said
    check.write_text((tmp_path / "moved.csv").read_text().replace(",6.1", ",7.1"))
    assert refuses("--check-survey", check) and refuses("--learn", 10)
    # The same numbers, driven the other way.
    check.write_text((tmp_path / "moved.csv").read_text().replace("run,x_mm", "run,direction,x_mm"))
    check.write_text(re.sub(r"^(\d),", r"\1,backward,", check.read_text(), flags=re.MULTILINE))
    assert refuses("--check-survey", check)


def test_an_acceptance_that_is_done_once_more_heeds_what_is_asked_for_now(done, commission):
    assert commission().code == 0
    # Whoever interrupts the repeat of an early step leaves the acceptance passed, but to be done again.
    done["safe_loop"] = interrupted
    assert commission("--only", "safe_loop").code == 130
    done["safe_loop"] = lambda work: Outcome(True, "once more")
    learned = []
    done["acceptance"] = lambda work: learned.append(work.learning_strokes) or Outcome(True, "learned")
    done["design"] = lambda work: Outcome(False, "no gains")
    code, _, said = commission()
    assert code == 1 and "next: the same command does the steps that are left: design" in said
    done["design"] = lambda work: Outcome(True, "gains")
    code, _, said = commission("--learn", 3)
    assert code == 0, said
    assert learned == [3]


def test_after_a_tolerance_that_is_not_kept_the_next_step_is_not_the_same_command(done, commission):
    done["certificate"] = lambda work: Outcome(work.require > 0.3, "judged")
    missed = commission("--require", 0.25)
    (said,) = (line for line in missed.err.splitlines() if line.startswith("next: "))
    assert missed.code == 1 and "--only STEP" in said and "--require" in said and "the same command" not in said
    # It does what it says.
    kept = commission("--require", 0.4)
    assert kept.code == 0 and "next: all is done" in kept.err


def as_described(work):
    """An identification that finds the machine as it is described, and what stays open of it."""
    facts = {f"uncertainty.{name}": open_ for name, open_ in STAYS_OPEN.items()}
    return Outcome(True, "as described", {"parameters": {}, "not_identifiable": []}, stage=facts)


ROUGHLY = {"mass": 0.8, "force": 1.2, "air_gap": 0.75, "friction": 0.5, "amplifier": 1.5}


@pytest.mark.parametrize(
    ("identification", "truth", "stroke", "few"),
    [
        # The search itself, which takes longer than all the rest, is in `test_estimate.py`.
        pytest.param(as_described, {}, 0.1, ["--evaluations", "6", "--machines", "2"], id="as described"),
        pytest.param(
            STEPS["identification"],
            ROUGHLY,
            1.76,
            ["--evaluations", "40", "--machines", "20"],
            id="whole",
            marks=pytest.mark.nightly,
        ),
    ],
)
def test_a_machine_that_is_roughly_known_ends_tuned_verified_and_documented(
    identification, truth, stroke, few, folder, commission, verb, monkeypatch
):
    monkeypatch.setattr(procedure, "STEPS", {**STEPS, "identification": identification})
    settings = {f"{TRUTH}{name}": value for name, value in truth.items()}
    settings |= {"driver.stage.drive.delay": 1.3, "stage.motion.stroke": stroke}
    words = [*(f"--set={name}={value}" for name, value in settings.items()), *few, "--json"]
    ended = commission(*words)
    found = ended.json
    assert ended.code == 0 and found["remaining"] == [] and list(found["steps"]) == list(STEPS)
    assert found["steps"]["frequency_response"]["figures"]["largest_deviation_dB"] < 1.0
    # 0.15 µm with full knowledge; as described, no law of this bandwidth is stable on this machine.
    assert found["steps"]["acceptance"]["figures"]["true_pp_um"] < 0.4
    assert left(folder) <= {*MADE, MARK}
    page = (folder / "certificate.html").read_text()
    assert "data:image/png;base64," in page and "phase margin" in page and "://" not in page
    certificate = json.loads((folder / "certificate.json").read_text())
    assert "bags/acceptance/acceptance_0.mcap" in certificate["sha256"]
    # What it wrote is what the other commands take.
    simulated = verb("simulate", "--params-file", folder / "tuned.yaml", "--json")
    assert simulated.code == 0 and simulated.json["law"] == "smc_observer"
    assert verb("evaluate", folder / "bags" / "acceptance", "--limits", folder / "limits.yaml").code == 0
    # Done is done.
    again = commission(*words)
    assert again.code == 0 and again.json["steps"] == {}


TRUTH = "driver.simulated.truth."
WELL_KNOWN = {f"stage.uncertainty.{name}": value for name, value in {"mass": 0.2, "force": 0.2, "air_gap": 0.1}.items()}


@pytest.mark.parametrize(
    ("settings", "wiring", "step", "words"),
    [
        # `test_open_loop.py` has all that the first two steps name.
        ({f"{TRUTH}amplifier": 0.1}, None, "signs_and_scales", "the amplifier has 50 Hz"),
        *nightly(
            [
                ({}, encoder_of_twice_the_count, "identification", "the count of the encoder"),
                ({f"{TRUTH}friction": 10.0}, None, "identification", "friction is"),
                ({**WELL_KNOWN, f"{TRUTH}mass": 0.5}, None, "identification", "look whether the platform is loose"),
            ]
        ),
    ],
    ids=["slow amplifier", "twice the count", "ten times the friction", "half the mass"],
)
def test_a_machine_that_is_not_as_described_is_named_at_the_first_step_that_can_see_it_and_left_without_current(
    monkeypatch, folder, commission, settings, wiring, step, words
):
    built = []

    def kept(hardware):
        built.append(wiring(hardware) if wiring else hardware)
        return built[-1]

    monkeypatch.setattr(machines, "SimulatedMachine", lambda values: SimulatedMachine(values, kept))
    chosen = (f"--set={name}={value}" for name, value in settings.items())
    ended = commission(*chosen, "--evaluations", 40, "--machines", 20, "--json")
    assert ended.code == 1 and ended.json["failed"] == step
    assert built and all(one.state is State.OFF and one.applied_current == 0.0 for one in built)
    steps = ended.json["steps"]
    assert ended.json["remaining"] == list(STEPS)[list(STEPS).index(step) :]
    assert [name for name, one in steps.items() if not one["passed"]] == [step] and words in steps[step]["sentence"]
    assert not (folder / "certificate.html").exists() and not (folder / "tuned.yaml").exists()


@pytest.fixture
def done(monkeypatch):
    """The steps, each of which only says that it was done; the third finds another mass each time, the fifth a law."""
    masses = itertools.count(3)

    def step(name, work):
        found = {"platform.mass": float(next(masses))} if name == "safe_loop" else {}
        gains = {"control.law": "smc"} if name == "design" else {}
        return Outcome(True, f"{name} at {work.stage.platform.mass:g} kg", {"law": str(work.values)}, found, gains)

    steps = {name: partial(step, name) for name in STEPS}
    monkeypatch.setattr(procedure, "STEPS", steps)
    return steps


def begun(folder, **stage):
    values = values_of(**stage)
    return Procedure(SimulatedMachine(values), values, folder, evaluations=1, machines=1)


def run(procedure, steps):
    """Do the steps, which leave their files."""
    for step in steps:
        procedure.run(step)
        for name in STEP_FILES.get(step, ()):
            (procedure.work(step).folder / name).write_text(step)
    return procedure


def test_after_an_interrupt_a_later_call_goes_on_with_that_step_and_with_what_those_before_it_found(done, tmp_path):
    one = run(begun(tmp_path, platform__mass=2.0), list(STEPS)[:4])
    before = (tmp_path / RECORD).read_bytes()
    design, done["design"] = done["design"], interrupted
    with pytest.raises(KeyboardInterrupt):
        one.run("design")
    done["design"] = design
    assert (tmp_path / RECORD).read_bytes() == before
    again = begun(tmp_path, platform__mass=2.0)
    assert again.remaining() == list(STEPS)[4:]
    assert again.outcomes["identification"].sentence == "identification at 3 kg"
    run(again, again.remaining())
    assert [again.work(step).stage.platform.mass for step in ("safe_loop", "design", "acceptance")] == [2.0, 3.0, 3.0]
    laws = [again.work(step).values["controller"].get("control.law") for step in ("design", "acceptance")]
    assert laws[0] != "smc" and laws[1] == "smc"


@pytest.mark.parametrize("learned", [{}, {"learning.learn": True, "learning.file": "learned.csv"}])
def test_no_step_learns_on_a_stage_that_learns_but_an_acceptance_that_is_to_and_the_certificate_is_of_that(
    done, tmp_path, learned
):
    values = with_values(values_of(), "controller", {"learning.learn": True, "learning.file": "mine.csv"})
    one = Procedure(SimulatedMachine(values), values, tmp_path, evaluations=1, machines=1)
    done["acceptance"] = lambda work: Outcome(True, "accepted", gains=learned)
    run(one, STEPS)
    learns = [step for step in STEPS if node_parameters("controller", one.work(step).values).learning.learn]
    assert learns == (["certificate"] if learned else [])


def left(folder):
    return {path.name for path in folder.iterdir()} - {RECORD}


def interrupted(work):
    raise KeyboardInterrupt


@pytest.mark.parametrize("step", ["connection", "frequency_response", "acceptance", "certificate"])
def test_a_step_that_is_repeated_voids_the_certificate_and_its_own_files_before_it_begins(done, tmp_path, step):
    one = run(begun(tmp_path), STEPS)
    written = {name for names in STEP_FILES.values() for name in names}
    assert left(tmp_path) == written and one.remaining() == []
    done[step] = interrupted
    with pytest.raises(KeyboardInterrupt):
        one.run(step)
    assert left(tmp_path) == written - {*STEP_FILES.get(step, ()), *STEP_FILES["certificate"]}
    # The bag of the step may be gone, so that the step is to be done again.
    again = begun(tmp_path)
    assert again.remaining() == list(STEPS)[list(STEPS).index(step) :]
    done[step] = lambda work: Outcome(True, "once more")
    assert run(again, again.remaining()).remaining() == []


def test_a_step_that_finds_something_else_voids_the_later_ones_and_a_failure_leaves_no_file_of_theirs(done, tmp_path):
    one = run(begun(tmp_path), STEPS)
    one.run("connection")
    assert one.remaining() == ["certificate"]
    one.run("safe_loop")
    assert one.remaining() == list(STEPS)[3:]
    run(one, one.remaining())
    done["connection"] = lambda work: Outcome(False, "no samples")
    one.run("connection")
    assert left(tmp_path) == set()
    assert begun(tmp_path).remaining() == list(STEPS)


def test_what_a_stroke_shows_of_the_machine_is_known_to_another_design(done, tmp_path):
    one, slips = run(begun(tmp_path), list(STEPS)[:6]), {"friction.model": "maxwell_slip"}

    def finds(work):
        return Outcome(True, "slips", before={} if work.stage.friction.model == slips["friction.model"] else slips)

    done["acceptance"] = finds
    run(one, ["acceptance"])
    assert one.remaining() == list(STEPS)[4:] and left(tmp_path).isdisjoint(STEP_FILES["frequency_response"])
    again = begun(tmp_path)
    assert (
        again.work("design").stage.friction.model == "maxwell_slip" != again.work("identification").stage.friction.model
    )
    assert run(again, again.remaining()).remaining() == []


def test_a_record_of_another_description_or_one_that_is_damaged_is_refused(done, tmp_path):
    begun(tmp_path).run("connection")
    with pytest.raises(CommissionRefused, match="is of another description"):
        begun(tmp_path, platform__mass=2.0)
    for text in ("", "[]", '{"steps": {"connection": {"colour": 1}}, "description": ""}'):
        (tmp_path / RECORD).write_text(text)
        with pytest.raises(CommissionRefused, match="cannot be read"):
            begun(tmp_path)


@pytest.mark.parametrize(
    ("parameter", "content"),
    [
        ("stage.guide.file", None),
        ("driver.simulated.truth.guide", None),
        ("stage.motion.file", "0.1\n0.2\n"),
        ("driver.simulated.truth.disturbances.force_file", "x_m,force_n\n0,0\n1,0.1\n"),
    ],
)
def test_a_record_is_of_what_the_files_of_the_description_held_when_it_was_begun(
    done, tmp_path, folder, commission, parameter, content
):
    file = tmp_path / "named.csv"
    file.write_text(content or Path(other_guide(file)).read_text())
    asked = "--set", f"{parameter}={file}"
    assert commission(*asked).code == 0
    record = (folder / RECORD).read_bytes()
    file.write_text(file.read_text().replace("0.1", "0.3"))
    code, _, said = commission(*asked)
    assert code == 2 and str(file) in said and "was changed since" in said and "name another folder" in said
    assert (folder / RECORD).read_bytes() == record
    # Also for a step alone; and the record serves again when the file holds what it held.
    assert commission(*asked, "--only", "certificate").code == 2
    file.write_text(file.read_text().replace("0.3", "0.1"))
    assert commission(*asked).code == 0
    # Wherever it is.
    (tmp_path / "moved").mkdir()
    moved = file.rename(tmp_path / "moved" / file.name)
    assert commission("--set", f"{parameter}={moved}").code == 0


def test_a_survey_that_is_changed_between_two_steps_ends_the_commission(done, tmp_path):
    file = tmp_path / "guide.csv"
    begun_with = begun(tmp_path, guide__file=other_guide(file))
    begun_with.run("connection")
    file.write_text(file.read_text() + "# measured again\n")
    with pytest.raises(CommissionRefused, match=f"was changed since .*{re.escape(str(file))}"):
        begun_with.run("signs_and_scales")
