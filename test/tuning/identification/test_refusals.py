"""What cannot be identified is refused, with what is wrong and what to do."""

import math

import numpy as np
import pytest

from straightcomp_ros.analysis import IdentificationError
from straightcomp_ros.analysis.current_path import read_recording
from straightcomp_ros.bags.topics import TopicQos
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import COMMAND, ENCODER
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.identification.unknowns import unknowns


def written(bag, y, current, streams=(ENCODER, COMMAND), lost=range(0)):
    """A bag of encoder and command at 2 kHz."""
    with BagWriter(bag) as writer:
        for stream in streams:
            writer.add_topic(f"/{stream.topic}", stream.layout.type_name, TopicQos())
        for k, (position, amperes) in enumerate(zip(y.tolist(), current.tolist(), strict=True)):
            stamp = 1_000_000_000 + 500_000 * k
            numbers = {ENCODER: (0.0, position, math.nan, amperes), COMMAND: (0.01,)}
            for stream in streams:
                if k not in lost:
                    writer.write(f"/{stream.topic}", stream.layout.pack(stamp, *numbers[stream]), stamp, stamp)
    return bag


MOVING = 1e-5 * np.sin(np.arange(5000) / 100.0)
ON = np.full(5000, 0.01)


@pytest.mark.parametrize(
    ("y", "current", "others", "words"),
    [
        (MOVING, np.full(5000, math.nan), {}, "amplifier is off throughout .* record with the amplifier on"),
        (np.where(np.arange(5000) % 2, 1e-7, 0.0), ON, {}, "nothing moves: the platform stays within 0.1 µm.*>= 2 µm"),
        (MOVING, ON, {"streams": (ENCODER,)}, "no messages on 'command'"),
        (MOVING[:3000], ON[:3000], {"lost": range(1500, 1510)}, "no sample lost has 1490 samples; allowed: >= 2000"),
    ],
    ids=["amplifier off", "nothing moves", "no commands", "a short stretch between losses"],
)
def test_a_bag_that_cannot_be_identified_is_refused(tmp_path, y, current, others, words):
    bag = written(tmp_path / "bag", y, current, **others)
    with pytest.raises(IdentificationError, match=words):
        read_recording(bag)


def test_the_longest_stretch_without_a_loss_is_used(tmp_path):
    recording = read_recording(written(tmp_path / "bag", MOVING, ON, lost=range(1000, 1001)))
    assert (len(recording.y), recording.total) == (5000 - 1001 - 10, 4999)
    np.testing.assert_allclose(recording.y, MOVING[1011:])


def test_forces_need_a_scale_so_mass_or_turns_must_be_known():
    with pytest.raises(IdentificationError, match=r"platform.mass or actuator.turns .* common factor"):
        unknowns(StageParameters(), ["friction.coulomb"])
    with pytest.raises(IdentificationError, match=r"'weight': is not among the unknowns; allowed: platform.mass,"):
        unknowns(StageParameters(), ["weight"])
