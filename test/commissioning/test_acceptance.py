"""On request the acceptance comes after strokes of learning, and what was learned is kept."""

import dataclasses
from pathlib import Path

from roughly_known import values_of, work_on

from straightcomp_ros.commissioning.acceptance import acceptance
from straightcomp_ros.commissioning.step_files import LEARNED


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
