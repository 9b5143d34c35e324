"""The action FollowJointTrajectory of a driver, with the interface built from what control_msgs describes."""

import shutil
import sys

import control_msgs_built
import pytest
from parameters_of_tests import PATIENT
from participant import Participant
from rclpy.action import ActionClient

from straightcomp_ros.contract import POSITION, STAGE
from straightcomp_ros.model.motion import Waypoint
from straightcomp_ros.runtime.graph_client import message_from_waypoints

pytestmark = [pytest.mark.live, pytest.mark.nightly]
if not (shutil.which("gcc") and shutil.which("g++")):
    pytest.skip("NOT TESTED: the action. Remedy: apt-get install g++ python3-dev", allow_module_level=True)

ACCEPTED, EXECUTING, _, SUCCEEDED, CANCELED, ABORTED = range(1, 7)
"""As of action_msgs/msg/GoalStatus."""


@pytest.fixture(scope="module")
def interface(tmp_path_factory):
    folder = tmp_path_factory.mktemp("interface")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AMENT_PREFIX_PATH", sys.prefix)
        control_msgs_built.build(folder)
        patch.syspath_prepend(folder)
        patch.setenv("PYTHONPATH", str(folder), prepend=":")
        yield


@pytest.fixture(scope="module")
def driver(interface, shared_graph):
    shared_graph.start("driver", PATIENT)


class Client(Participant):
    """A client of the action."""

    def __init__(self):
        from control_msgs.action import FollowJointTrajectory

        super().__init__("client")
        self.kind, self.feedback = FollowJointTrajectory, []
        self.action = ActionClient(self.node, FollowJointTrajectory, "driver/follow_joint_trajectory")
        self.until(self.action.server_is_ready)

    def send(self, points, joints=(STAGE,), **fields):
        trajectory = message_from_waypoints(points)
        trajectory.joint_names = list(joints)
        goal = self.kind.Goal(trajectory=trajectory, **fields)
        sent = self.action.send_goal_async(goal, lambda message: self.feedback.append(message.feedback))
        self.until(sent.done)
        assert sent.result().accepted
        return sent.result()

    def result(self, handle):
        asked = handle.get_result_async()
        self.until(asked.done)
        return asked.result().status, asked.result().result

    def follow(self, points, **fields):
        return self.result(self.send(points, **fields))


@pytest.fixture
def client(driver, own_domain):
    with Client() as client:
        client.trigger("driver/reset_fault")
        yield client


def to(x, seconds):
    """A goal as clients send it: where to be, and when."""
    return [Waypoint(round(seconds * 1e9), x, 0.0)]


def test_a_goal_is_followed_with_feedback_and_ends_in_success_from_wherever_the_stage_is(client):
    status, result = client.follow(to(0.02, 2.0))
    assert (status, result.error_code) == (SUCCEEDED, 0) and "0.02000" in result.error_string
    x = [one.actual.positions[0] for one in client.feedback]
    assert len(x) > 10 and x[-1] == pytest.approx(0.02, abs=1e-5) and client.feedback[0].joint_names == [STAGE]
    assert max(abs(one.error.positions[0]) for one in client.feedback) < 1e-3


def test_a_canceled_goal_comes_to_rest_within_its_limits_and_the_next_begins_there(client):
    handle = client.send(to(0.2, 6.0))
    client.until(lambda: client.feedback and client.feedback[-1].actual.positions[0] > 0.04)
    assert handle.status in (ACCEPTED, EXECUTING)
    canceled = handle.cancel_goal_async()
    client.until(canceled.done)
    assert canceled.result().goals_canceling
    status, result = client.result(handle)
    x = client.feedback[-1].actual.positions[0]
    assert status == CANCELED and "canceled" in result.error_string and 0.04 < x < 0.19
    status, _ = client.follow(to(0.0, 5.0))
    assert status == SUCCEEDED


def test_a_goal_that_the_stage_cannot_follow_is_aborted_at_once_with_its_code(client):
    for points, joint, code, words in (
        (to(0.0, 1.0), "arm", -2, "joints ['arm']"),
        (to(50.0, 1.0), STAGE, -1, "allowed for this stage"),
    ):
        status, result = client.follow(points, joints=[joint])
        assert status == ABORTED and result.error_code == code
        assert result.error_string.startswith("refused: ") and words in result.error_string


def test_a_goal_during_a_motion_is_refused_or_with_blend_takes_its_place_at_the_speed_that_there_is(client):
    first = client.send(to(0.1, 4.0))
    client.until(lambda: client.feedback and client.feedback[-1].actual.positions[0] > 0.03)
    status, result = client.follow(to(0.0, 5.0))
    assert status == ABORTED and "is moving" in result.error_string
    assert client.set("driver", {"blend": True}).successful
    seen = len(client.feedback)
    second = client.send(to(0.0, 5.0))
    status, result = client.result(first)
    assert status == ABORTED and "another goal" in result.error_string
    assert client.result(second)[0] == SUCCEEDED
    # It goes on forwards before it turns.
    x = [one.actual.positions[0] for one in client.feedback[seen:]]
    assert max(x) > x[0] + 1e-3 and x[-1] == pytest.approx(0.0, abs=1e-5)
    assert client.set("driver", {"blend": False}).successful


def test_a_fault_aborts_a_goal_with_its_reason(client):
    handle = client.send(to(0.05, 4.0))
    client.trip("the door is open")
    status, result = client.result(handle)
    assert status == ABORTED and "the door is open" in result.error_string
    client.trigger("driver/reset_fault")
    client.until(lambda: client.follow(to(0.0, 5.0))[0] == SUCCEEDED)


def test_a_motion_that_takes_the_place_of_a_goal_goes_on_and_its_stamp_says_when_it_begins(client):
    assert client.set("driver", {"blend": True}).successful
    first = client.send(to(0.1, 4.0))
    client.until(lambda: client.feedback and client.feedback[-1].actual.positions[0] > 0.02)
    client.move(to(0.06, 3.0))
    status, result = client.result(first)
    assert status == ABORTED and "another motion" in result.error_string
    client.until(lambda: client.received(POSITION, 1)[-1][0] == pytest.approx(0.06, abs=1e-5))
    client.move(to(0.0, 1.0), begin_s=1000)
    client.spin(2.0)
    assert client.received(POSITION, 1)[-1][0] == pytest.approx(0.06, abs=1e-5)
    assert client.follow(to(0.0, 4.0))[0] == SUCCEEDED
    assert client.set("driver", {"blend": False}).successful


def test_a_driver_that_ends_answers_its_goal_and_ends_well(client, shared_graph):
    handle = client.send(to(0.05, 4.0))
    client.until(lambda: client.feedback)
    asked = handle.get_result_async()
    client.spin(0.5)
    assert shared_graph.stop(["driver"])["driver"] == 0
    client.until(asked.done)
    assert "not active any more" in asked.result().result.error_string
