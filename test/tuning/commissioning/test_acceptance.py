"""What the acceptance judges: a stroke after those of learning, on request, and none that the host disturbed."""

import dataclasses
import math
import shutil

import numpy as np
import pytest
from roughly_known import check_of, other_guide, values_of, work_on
from tiers import nightly

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.interruption import Stall
from straightcomp_ros.model.friction import BLOCKS
from straightcomp_ros.offline.starts import run_stroke, with_values
from straightcomp_ros.tuning.commissioning import LEARNED, LIMITS
from straightcomp_ros.tuning.commissioning import acceptance as acceptance_step
from straightcomp_ros.tuning.commissioning.acceptance import acceptance, timing_budget
from straightcomp_ros.tuning.commissioning.machine import SimulatedMachine

STALL, APART = 0.03, 0.5
"""s."""
VALUES = values_of(motion__stroke=0.1)
TIMING = {"in_time_pp_um": 0.2, "as_measured_costs_um": 0.0}


def stalled(hardware):
    """A machine that gets no command while its host stalls: for 30 ms in every half second."""
    write = hardware.write

    def in_time(current, at_ns, sample_ns=None):
        if at_ns % round(APART * 1e9) >= STALL * 1e9:
            write(current, at_ns, sample_ns)

    hardware.write = in_time
    return hardware


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """A calm stroke and one whose host stalled, recorded once."""
    folder = tmp_path_factory.mktemp("strokes")
    for name, wiring in (("calm", None), ("stalled", stalled)):
        SimulatedMachine(VALUES, wiring).stroke(VALUES, folder / name, 2e-4)
    return folder


@pytest.fixture
def judged_at_once(monkeypatch):
    """What late commands cost is not computed, and no stroke is drawn, which takes longer than all the rest."""
    monkeypatch.setattr("straightcomp_ros.analysis.pictures.plot_run", lambda *_: None)
    monkeypatch.setattr(acceptance_step, "timing_budget", lambda values, latency, travel: TIMING)


@pytest.fixture
def accepted(monkeypatch, judged_at_once, bags, tmp_path):
    """The acceptance on a host that disturbs its first strokes, and how many it makes; each is a recorded one.

    A simulation knows no stall: they are put where the evaluation finds those of a bag.
    """

    def run(disturbed=0, lost_samples=0, **changes):
        work, strokes = work_on(VALUES, tmp_path), []

        def stroke(values, bag, travel, count=1):
            strokes.append(bag)
            shutil.rmtree(bag, ignore_errors=True)
            stalls = len(strokes) <= disturbed and not lost_samples
            shutil.copytree(bags / ("stalled" if stalls else "calm"), bag)

        def evaluated(bag):
            found = evaluate_bag(bag)
            if len(strokes) > disturbed:
                return found
            starts = np.arange(APART, found.record.time[-1], APART).tolist()
            stalls = tuple(Stall(start, start + STALL) for start in starts)
            return dataclasses.replace(found, stalls=stalls, stamps=np.delete(found.stamps, range(1, 1 + lost_samples)))

        monkeypatch.setattr(acceptance_step, "evaluate_bag", evaluated)
        monkeypatch.setattr(work.machine, "stroke", stroke)
        return acceptance(dataclasses.replace(work, **changes)), len(strokes)

    return run


def test_a_stroke_that_the_host_disturbed_does_not_count_and_another_one_is_made_twice_at_most(accepted, tmp_path):
    outcome, strokes = accepted(9)
    assert not outcome.passed and strokes == 3
    assert outcome.sentence.startswith("the stroke is not in order: starved: ")
    assert not (tmp_path / LIMITS).exists()
    outcome, strokes = accepted(2)
    assert outcome.passed and strokes == 3, outcome.sentence
    assert "(2 before it, disturbed by the host: starved: the " in outcome.sentence
    assert len(outcome.figures["disturbed_strokes"]) == 2
    calm, _ = accepted()
    assert calm.figures == {**outcome.figures, "disturbed_strokes": []}
    assert "the survey of the guide was not verified" in calm.sentence
    assert calm.figures["lost_samples"] == calm.figures["lost_commands"] == 0


def test_a_stroke_of_which_samples_were_lost_does_not_count_though_it_is_in_order(accepted):
    outcome, _ = accepted(1, lost_samples=2)
    assert outcome.passed and outcome.figures["lost_samples"] == 0, outcome.sentence
    assert outcome.figures["disturbed_strokes"] == ["lost samples of the stroke 2 (allowed: <= 0)"]


@pytest.mark.parametrize("agrees", [True, False])
def test_a_check_of_the_guide_finds_the_wrong_survey(tmp_path, accepted, agrees):
    guide = "config/guide_synthetic.csv" if agrees else other_guide(tmp_path / "other.csv")
    outcome, _ = accepted(check_survey=check_of(guide, tmp_path / "check.csv"))
    assert outcome.passed is outcome.figures["survey_agrees"] is agrees
    assert ("the survey agrees with the check" in outcome.sentence) is agrees
    assert ("the survey is not that of the guide: they differ by" in outcome.sentence) is not agrees
    assert (tmp_path / LIMITS).exists() is agrees and outcome.figures["survey_check_points"] == 15


def test_the_stroke_is_better_after_learning_and_the_correction_is_a_gain_of_the_step(tmp_path, judged_at_once):
    values = with_values(VALUES, "controller", {"control.law": "linear"})
    work = dataclasses.replace(work_on(values, tmp_path / "learned"), learning_strokes=6)
    learned = acceptance(work)
    assert learned.passed and "after 6 strokes of learning" in learned.sentence
    assert learned.gains == {"learning.learn": True, "learning.file": str(work.folder / LEARNED)}
    assert (work.folder / LEARNED).is_file()
    # Without learning no bag of it is left, which the certificate would name.
    plain = acceptance(dataclasses.replace(work, learning_strokes=0))
    assert plain.passed and plain.gains == {} and "learning" not in plain.sentence
    assert not (work.folder / "bags" / "learning").exists()
    assert learned.figures["encoder_rms_um"] < 0.6 * plain.figures["encoder_rms_um"]


@pytest.mark.parametrize(
    ("machine", "described", "found"),
    [
        ({}, "lugre", {}),
        ({"contact.model": BLOCKS}, "lugre", {"friction.model": BLOCKS}),
        *nightly([({}, BLOCKS, {}), ({"friction": 1.05, "force": 1.03}, "lugre", {})]),
    ],
)
def test_a_stroke_shows_that_friction_gives_way_as_blocks_do(tmp_path, judged_at_once, machine, described, found):
    truth = {f"simulated.truth.{name}": value for name, value in machine.items()}
    values = values_of(truth, motion__stroke=0.2, friction__model=described)
    outcome = acceptance(work_on(values, tmp_path))
    assert outcome.passed and outcome.before == found


def test_an_error_is_the_blocks_only_where_they_explain_it(accepted, monkeypatch):
    measured = accepted()[0].figures["encoder_rms_um"]
    for bristles, blocks, found in (
        (1.0, 1.5, False),
        (0.95, 1.0, False),  # bristles explain it
        (0.8, 1.0, True),
        (0.5, 0.9, True),
        (0.5, 0.6, False),  # another cause makes most of it
        (0.5, 2.5, False),
        (0.8, math.inf, False),
        (math.inf, 1.0, False),
    ):

        def predicted(values, late, bristles=bristles, blocks=blocks):
            return [measured * (blocks if values["stage"].get("friction.model") == BLOCKS else bristles)]

        monkeypatch.setattr(acceptance_step, "_predicted", predicted)
        assert bool(accepted()[0].before) is found, (bristles, blocks)


def test_a_platform_that_late_commands_lose_costs_infinitely_much(monkeypatch):
    def lost(values, delays=None):
        if delays is not None:
            raise ValueError("position or control current is not finite")
        return run_stroke(values)

    monkeypatch.setattr(acceptance_step, "run_stroke", lost)
    found = timing_budget(VALUES, np.full(1000, 6e-4), 2e-4)
    assert found["as_measured_costs_um"] == found["p99_costs_um"] == math.inf
    assert set(found["stall_error_um"].values()) == {math.inf} and found["longest_stall_survived_ms"] == 0
    assert math.isfinite(found["in_time_pp_um"])


def test_a_stall_in_a_cycle_that_is_shorter_than_the_settling_is_survived():
    short = with_values(VALUES, "stage", {"motion.stroke": 0.02, "motion.settle": 0.0, "motion.pause": 0.0})
    found = timing_budget(short, np.full(1000, 5e-4), 2e-4)
    assert found["longest_stall_survived_ms"] > 0 and found["stall_error_um"]["1 ms"] < 200.0


def test_commands_in_time_cost_nothing_and_none_are_not_judged():
    early = timing_budget(VALUES, np.array([1e-4, math.nan, 5e-4]), 2e-4)
    assert early["as_measured_costs_um"] == early["p99_costs_um"] == 0.0
    assert "as_measured_costs_um" not in timing_budget(VALUES, np.full(5, math.nan), 2e-4)
