"""Strokes that were commanded, and those that are in a bag."""

import numpy as np
import pytest

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import ENCODER
from straightcomp_ros.model.motion import Trajectory, Waypoint, trapezoid
from trials.soak_strokes import Commanded, Stroke, missing, readable, strokes_in

START, SECOND = 1_700_000_000_000_000_000, 10**9
STROKE, STROKES = 1_250_000_000, 8
"""0.1 m at 0.1 m/s and 0.4 m/s²."""


def motion():
    points = [Waypoint(0, 0.0, 0.0)]
    for number in range(STROKES):
        points += trapezoid(points[-1], 0.0 if number % 2 else 0.1, 0.1, 0.4)
    return Trajectory(points)


def commanded(recordings=((-1.0, 20.0),), end_s=15.0):
    """A motion that begins at START and ends by itself or after ``end_s``, recorded in these spans (s)."""
    notes = Commanded(STROKE, STROKES)
    notes.moving = START
    notes.end(START + round(end_s * SECOND))
    for begin, end in recordings:
        notes.recording = START + round(begin * SECOND)
        notes.interrupt(START + round(end * SECOND))
    return notes


def bag_of(folder, spans=((-0.5, 11.0),)):
    """A bag with the motion's samples of these spans (s), at 500 Hz."""
    stage = motion()
    with BagWriter(folder) as bag:
        bag.add_topic("/encoder", ENCODER.layout.type_name)
        for begin, end in spans:
            for time_ns in range(round(begin * SECOND), round(end * SECOND), 2_000_000):
                stamp = START + time_ns
                bag.write(
                    "/encoder", ENCODER.layout.pack(stamp, stage.position(time_ns), 0.0, np.nan, 0.0), stamp, stamp
                )
    return folder


def test_strokes_count_that_lie_as_a_whole_in_the_motion_and_in_one_recording():
    assert len(commanded().strokes()) == STROKES
    assert len(commanded(end_s=5.1).strokes()) == 4
    strokes = commanded(recordings=((1.0, 4.0), (4.5, 8.0))).strokes()
    assert [(stroke.begin_ns - START) / STROKE for stroke in strokes] == [1, 2, 4, 5]
    assert [stroke.direction for stroke in strokes] == ["backward", "forward", "forward", "backward"]
    assert commanded(recordings=()).strokes() == []


def test_what_was_recorded_before_an_interruption_that_reaches_back_does_not_count():
    notes = Commanded(STROKE, STROKES)
    notes.moving = START
    notes.recording = START + SECOND
    notes.interrupt(START + SECOND - 1)
    notes.end(START + 20 * SECOND)
    assert notes.strokes() == [] and not notes.recording and not notes.moving


def test_all_strokes_of_a_whole_bag_are_found(tmp_path):
    notes = commanded()
    found = strokes_in(bag_of(tmp_path / "bag"), notes.motions)
    assert len(found) == STROKES
    assert missing(notes.strokes(), found) == []


def test_strokes_that_are_not_in_the_bag_are_missed(tmp_path):
    notes = commanded()
    found = strokes_in(bag_of(tmp_path / "bag", spans=((-0.5, 3.75), (6.25, 11.0))), notes.motions)
    assert [(stroke.begin_ns - START) / STROKE for stroke in missing(notes.strokes(), found)] == [3, 4]
    assert len(missing(notes.strokes(), [])) == STROKES


def test_a_gap_of_a_third_of_a_second_loses_no_stroke(tmp_path):
    notes = commanded()
    found = strokes_in(bag_of(tmp_path / "bag", spans=((-0.5, 3.6), (3.95, 11.0))), notes.motions)
    assert missing(notes.strokes(), found) == []


def test_a_stroke_of_the_other_direction_or_of_twice_the_length_is_another():
    stroke = Stroke(START, START + STROKE, "forward")
    assert missing([stroke], [stroke]) == []
    assert missing([stroke], [stroke._replace(direction="backward")])
    assert missing([stroke], [stroke._replace(end_ns=START + 2 * STROKE)])
    assert missing([stroke], [stroke._replace(begin_ns=START + STROKE * 6 // 10)])


def test_an_unfinished_bag_is_recovered_and_has_its_strokes(tmp_path):
    bag = bag_of(tmp_path / "bag")
    assert readable(bag) == (bag, True)
    (bag / "metadata.yaml").unlink()
    file = next(bag.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[:-300])
    output, finished = readable(bag)
    assert output != bag and not finished
    assert len(strokes_in(output, commanded().motions)) == STROKES


def test_a_bag_of_which_nothing_can_be_saved_is_an_error(tmp_path):
    bag = bag_of(tmp_path / "bag", spans=())
    (bag / "metadata.yaml").unlink()
    with pytest.raises(BagError, match="no message could be saved"):
        readable(bag)
