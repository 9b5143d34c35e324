"""What the acceptance judges: a stroke after those of learning, on request, and none that the host disturbed."""

import dataclasses
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from roughly_known import check_of, other_guide, values_of, work_on

from straightcomp_ros.analysis.evaluation import BagEvaluation, evaluate_bag
from straightcomp_ros.analysis.interruption import Stall
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.offline.starts import run_stroke
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.tuning.commissioning import LEARNED, LIMITS
from straightcomp_ros.tuning.commissioning import acceptance as acceptance_step
from straightcomp_ros.tuning.commissioning.acceptance import acceptance, allowed_cost_um, timing_budget
from straightcomp_ros.tuning.commissioning.machine import SimulatedMachine
from straightcomp_ros.tuning.commissioning.step import Outcome
from trials.faulty_machine import FaultyHardware

STALL, APART = 0.03, 0.5
"""s."""
VALUES = values_of(motion__stroke=0.1)
TIMING = {"in_time_pp_um": 0.2, "as_measured_costs_um": 0.0}


class Stalled(FaultyHardware):
    """A machine that gets no command while its host stalls: for 30 ms in every half second."""

    def __init__(self, inner: SimulatedHardware) -> None:
        super().__init__(inner, lambda kind, at_ns: None)

    def write(self, current: float, at_ns: int, sample_ns: int | None = None) -> None:
        if at_ns % round(APART * 1e9) >= STALL * 1e9:
            super().write(current, at_ns, sample_ns)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A calm stroke and one whose host stalled, recorded once."""
    folder = tmp_path_factory.mktemp("strokes")
    for name, wiring in (("calm", lambda hardware: hardware), ("stalled", Stalled)):
        SimulatedMachine(VALUES, wiring).stroke(VALUES, folder / name, 2e-4)
    return {name: folder / name for name in ("calm", "stalled")}


class Host(SimulatedMachine):
    """A machine on a host that disturbs its first strokes; each stroke is one of the recorded ones.

    A simulation knows no stall: they are put where the evaluation finds those of a bag.
    """

    def __init__(
        self, bags: dict[str, Path], monkeypatch: pytest.MonkeyPatch, disturbed: int = 0, lost_samples: int = 0
    ) -> None:
        super().__init__(VALUES)
        self._bags, self._disturbed, self._lost_samples, self.strokes = bags, disturbed, lost_samples, 0
        monkeypatch.setattr(acceptance_step, "evaluate_bag", self._evaluated)
        monkeypatch.setattr(acceptance_step, "timing_budget", lambda values, latency, travel: TIMING)

    @property
    def _disturbs(self) -> bool:
        return self.strokes <= self._disturbed

    def stroke(self, values: Values, bag: Path, travel: float, count: int = 1) -> None:
        self.strokes += 1
        shutil.rmtree(bag, ignore_errors=True)
        stalls = self._disturbs and not self._lost_samples
        shutil.copytree(self._bags["stalled" if stalls else "calm"], bag)

    def _evaluated(self, bag: Path) -> BagEvaluation:
        found = evaluate_bag(bag)
        if not self._disturbs:
            return found
        starts = np.arange(APART, found.record.time[-1], APART).tolist()
        stalls = tuple(Stall(start, start + STALL) for start in starts)
        received = found.received_samples - self._lost_samples
        return dataclasses.replace(found, stalls=stalls, received_samples=received)

    def accepted(self, folder: Path, **changes) -> Outcome:
        return acceptance(dataclasses.replace(work_on(VALUES, folder), machine=self, **changes))


@pytest.mark.parametrize("disturbed", [1, 2])
def test_a_stroke_that_the_host_disturbed_does_not_count_and_another_one_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bags: dict[str, Path], disturbed: int
) -> None:
    host = Host(bags, monkeypatch, disturbed)
    outcome = host.accepted(tmp_path / "disturbed")
    assert outcome.passed, outcome.sentence
    assert host.strokes == disturbed + 1
    assert f"({disturbed} before it, disturbed by the host: starved: stalls of the host" in outcome.sentence
    assert len(outcome.figures["disturbed_strokes"]) == disturbed
    calm = Host(bags, monkeypatch).accepted(tmp_path / "calm")
    assert calm.figures == {**outcome.figures, "disturbed_strokes": []}
    assert "the survey of the guide was not verified" in calm.sentence
    assert calm.figures["lost_samples"] == calm.figures["lost_commands"] == 0


def test_a_host_that_disturbs_every_stroke_passes_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bags: dict[str, Path]
) -> None:
    host = Host(bags, monkeypatch, 9)
    outcome = host.accepted(tmp_path)
    assert not outcome.passed and host.strokes == 3
    assert outcome.sentence.startswith("the stroke is not in order: starved: ")
    assert not (tmp_path / LIMITS).exists()


def test_a_stroke_of_which_samples_were_lost_does_not_count_though_it_is_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bags: dict[str, Path]
) -> None:
    outcome = Host(bags, monkeypatch, 1, lost_samples=2).accepted(tmp_path)
    assert outcome.passed, outcome.sentence
    assert outcome.figures["disturbed_strokes"] == ["lost samples of the stroke 2 (allowed: <= 0)"]
    assert outcome.figures["lost_samples"] == 0


@pytest.mark.parametrize("agrees", [True, False])
def test_a_check_of_the_guide_finds_the_wrong_survey(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bags: dict[str, Path], agrees: bool
) -> None:
    guide = "config/guide_synthetic.csv" if agrees else other_guide(tmp_path / "other.csv")
    check = check_of(guide, tmp_path / "check.csv")
    outcome = Host(bags, monkeypatch).accepted(tmp_path, check_survey=check)
    assert outcome.passed is outcome.figures["survey_agrees"] is agrees
    assert ("the survey agrees with the check" in outcome.sentence) is agrees
    assert ("the survey is not that of the guide: they differ by" in outcome.sentence) is not agrees
    assert (tmp_path / LIMITS).exists() is agrees and outcome.figures["survey_check_points"] == 15


def test_the_stroke_is_better_after_learning_and_the_correction_is_a_gain_of_the_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acceptance_step, "timing_budget", lambda values, latency, travel: TIMING)
    values = values_of(motion__stroke=0.1)
    values["controller"]["control.law"] = "linear"
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


def test_a_platform_that_late_commands_lose_costs_infinitely_much(monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(values, delays=None):
        if delays is not None:
            raise ValueError("position or control current is not finite")
        return run_stroke(values)

    monkeypatch.setattr(acceptance_step, "run_stroke", lost)
    found = timing_budget(VALUES, np.full(1000, 6e-4), 2e-4)
    assert found["as_measured_costs_um"] == found["p99_costs_um"] == math.inf
    assert set(found["stall_error_um"].values()) == {math.inf} and found["longest_stall_survived_ms"] == 0
    assert math.isfinite(found["in_time_pp_um"])


def test_commands_in_time_cost_nothing_and_commands_without_latencies_are_not_judged() -> None:
    early = timing_budget(VALUES, np.array([1e-4, math.nan, 5e-4]), 2e-4)
    assert early["as_measured_costs_um"] == early["p99_costs_um"] == 0.0
    assert "as_measured_costs_um" not in timing_budget(VALUES, np.full(5, math.nan), 2e-4)


def test_late_commands_may_double_the_error_or_add_a_count() -> None:
    assert allowed_cost_um({"in_time_pp_um": 0.25}, 1e-7) == 0.25
    assert allowed_cost_um({"in_time_pp_um": 0.05}, 1e-7) == pytest.approx(0.1)
