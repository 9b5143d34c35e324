"""What the acceptance judges: a stroke after those of learning, on request, and none that the host disturbed."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from roughly_known import values_of, work_on

from straightcomp_ros.analysis.evaluation import BagEvaluation, evaluate_bag
from straightcomp_ros.analysis.host_stalls import Stall
from straightcomp_ros.hardware.interface import Hardware
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.tuning.commissioning import LEARNED, LIMITS
from straightcomp_ros.tuning.commissioning import acceptance as acceptance_step
from straightcomp_ros.tuning.commissioning.acceptance import acceptance
from trials.faults.faulty_machine import FaultyHardware

STALL, APART = 0.03, 0.5
"""s."""
VALUES = values_of(motion__stroke=0.1)


class Stalled(FaultyHardware):
    """A machine that gets no command while its host stalls: for 30 ms in every half second."""

    def __init__(self, inner: SimulatedHardware) -> None:
        super().__init__(inner, lambda kind, at_ns: None)

    def write(self, current: float, at_ns: int, sample_ns: int | None = None) -> None:
        if at_ns % round(APART * 1e9) >= STALL * 1e9:
            super().write(current, at_ns, sample_ns)


class StallingHost:
    """A host that stalls in the first strokes.

    A simulation knows no stall: they are put where the evaluation finds those of a bag.
    """

    def __init__(self, stalling: int, monkeypatch: pytest.MonkeyPatch, lost_samples: int = 0) -> None:
        self.stalling, self.strokes = stalling, 0
        self._lost_samples = lost_samples
        monkeypatch.setattr(acceptance_step, "evaluate_bag", self._evaluated)

    def wiring(self, hardware: SimulatedHardware) -> Hardware:
        self.strokes += 1
        return Stalled(hardware) if self._stalls and not self._lost_samples else hardware

    @property
    def _stalls(self) -> bool:
        return self.strokes <= self.stalling

    def _evaluated(self, bag: Path) -> BagEvaluation:
        found = evaluate_bag(bag)
        if not self._stalls:
            return found
        starts = np.arange(APART, found.record.time[-1], APART).tolist()
        stalls = tuple(Stall(start, start + STALL) for start in starts)
        received = found.received_samples - self._lost_samples
        return dataclasses.replace(found, stalls=stalls, received_samples=received)


def test_the_stroke_is_better_after_learning_and_the_correction_is_a_gain_of_the_step(tmp_path: Path) -> None:
    values = values_of(motion__stroke=0.1)
    values["controller"]["control.law"] = "linear"
    plain = acceptance(work_on(values, tmp_path / "plain"))
    work = dataclasses.replace(work_on(values, tmp_path / "learned"), learning_strokes=6)
    learned = acceptance(work)
    assert plain.passed and learned.passed, (plain.sentence, learned.sentence)
    assert plain.gains == {} and "learning" not in plain.sentence
    assert plain.figures["lost_samples"] == plain.figures["lost_commands"] == 0
    assert "after 6 strokes of learning" in learned.sentence
    assert learned.figures["encoder_rms_um"] < 0.6 * plain.figures["encoder_rms_um"]
    assert learned.gains == {"learning.learn": True, "learning.file": str(work.folder / LEARNED)}
    assert (work.folder / LEARNED).is_file()
    # Once more it learns anew.
    assert acceptance(work).figures["encoder_rms_um"] == learned.figures["encoder_rms_um"]
    # Without learning no bag of it is left, which the certificate would name.
    acceptance(dataclasses.replace(work, learning_strokes=0))
    assert not (work.folder / "bags" / "learning").exists()


@pytest.mark.parametrize("stalling", [1, 2])
def test_a_stroke_that_the_host_disturbed_does_not_count_and_another_one_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stalling: int
) -> None:
    host = StallingHost(stalling, monkeypatch)
    outcome = acceptance(work_on(VALUES, tmp_path / "stalled", host.wiring))
    assert outcome.passed, outcome.sentence
    assert host.strokes == stalling + 1
    assert f"({stalling} before it, disturbed by the host: starved: stalls of the host" in outcome.sentence
    assert len(outcome.figures["disturbed_strokes"]) == stalling
    calm = acceptance(work_on(VALUES, tmp_path / "calm"))
    assert calm.figures == {**outcome.figures, "disturbed_strokes": []}


def test_a_host_that_disturbs_every_stroke_passes_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    host = StallingHost(9, monkeypatch)
    outcome = acceptance(work_on(VALUES, tmp_path, host.wiring))
    assert not outcome.passed
    assert host.strokes == 3
    assert outcome.sentence.startswith("the stroke is not in order: starved: ")
    assert not (tmp_path / LIMITS).exists()


def test_a_stroke_of_which_samples_were_lost_does_not_count_though_it_is_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = StallingHost(1, monkeypatch, lost_samples=2)
    outcome = acceptance(work_on(VALUES, tmp_path, host.wiring))
    assert outcome.passed, outcome.sentence
    assert outcome.figures["disturbed_strokes"] == ["lost samples of the stroke 2 (allowed: <= 0)"]
    assert outcome.figures["lost_samples"] == 0
