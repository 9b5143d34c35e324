"""The stage's trajectory out of its bytes, as an independent serialiser writes them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from straightcomp_ros.messages.joint_trajectory import MOST_POINTS, read_trajectory
from straightcomp_ros.model.motion import Trajectory, Waypoint

TYPES = get_typestore(Stores.ROS2_JAZZY)
KIND = "trajectory_msgs/msg/JointTrajectory"
JOINT = "stage_x"


def message(points, joints=(JOINT,), frame=""):
    """Bytes of points (time in ns, positions, velocities, accelerations, effort)."""
    types = TYPES.types
    duration, header = types["builtin_interfaces/msg/Duration"], types["std_msgs/msg/Header"]
    made = [
        types["trajectory_msgs/msg/JointTrajectoryPoint"](
            *(np.array(array, float) for array in arrays), duration(*divmod(time_ns, 10**9))
        )
        for time_ns, *arrays in points
    ]
    stamp = types["builtin_interfaces/msg/Time"](1, 2)
    return bytes(TYPES.serialize_cdr(types[KIND](header(stamp, frame), list(joints), made), KIND))


def straight(count):
    """Points that have a position and a velocity, the usual ones."""
    return [(k * 10**7, [0.01 * k], [0.0 if k == count - 1 else 1.0], [], []) for k in range(count)]


NUMBERS = st.floats(-10.0, 10.0)


@given(st.data(), st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=9))
def test_points_are_read_however_long_their_arrays_are(data, frame):
    joints = data.draw(st.permutations([JOINT, "turret", "z"]))[: data.draw(st.integers(1, 3))]
    if JOINT not in joints:
        joints.append(JOINT)
    place, points, expected = joints.index(JOINT), [], []
    for _ in range(data.draw(st.integers(1, 4))):
        lengths = [len(joints), *(data.draw(st.integers(0, 4)) for _ in range(3))]
        for _ in range(data.draw(st.integers(1, 4))):
            arrays = [data.draw(st.lists(NUMBERS, min_size=length, max_size=length)) for length in lengths]
            velocity = arrays[1][place] if place < lengths[1] else 0.0
            points.append((1 + len(points) * 1_500_000_001, *arrays))
            expected.append(Waypoint(points[-1][0], arrays[0][place], velocity))
    points.append((10**12, [1.0] * len(joints), [], [], []))
    stamp_ns, read = read_trajectory(message(points, joints, frame) + bytes(data.draw(st.integers(0, 9))), JOINT)
    assert stamp_ns == 1_000_000_002
    assert Trajectory.from_columns(*read).waypoints == [*expected, Waypoint(10**12, 1.0, 0.0)]


def test_each_cut_off_message_is_refused():
    whole = message(straight(3))
    assert len(read_trajectory(whole, JOINT)[1][0]) == 3
    for length in range(len(whole)):
        with pytest.raises(ValueError, match=r"no whole message|encapsulation"):
            read_trajectory(whole[:length], JOINT)


def test_as_many_points_as_the_longest_cycle_has_are_read_and_one_more_is_refused_before_any():
    assert len(read_trajectory(message(straight(MOST_POINTS)), JOINT)[1][0]) == MOST_POINTS
    more = message(straight(MOST_POINTS + 1))
    with pytest.raises(ValueError, match=f"{MOST_POINTS + 1} points; allowed: <= {MOST_POINTS}"):
        read_trajectory(more[:100], JOINT)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (message(straight(2), ["turret"]), "do not include 'stage_x'"),
        (message(straight(2), [*"abcdefgh"] * 9), "72 joints; allowed: <= 64"),
        (message([*straight(1), (10**9, [], [], [], [])]), "point 1 has no position"),
        (message([(-(10**9), [0.0], [], [], []), *straight(1)]), "point 0: time -1.0 s; allowed: >= 0 s"),
        (message([(k, [0.0] * (1 + k % 2), [], [], []) for k in range(40)]), "17 times"),
        (b"\0\0" + message(straight(2))[2:], "not little-endian"),
    ],
)
def test_what_is_no_motion_of_the_stage_is_refused(data, words):
    with pytest.raises(ValueError, match=words):
        read_trajectory(data, JOINT)
