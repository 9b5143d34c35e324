"""The driver as others see it: over its topics and services."""

import itertools
import math
import os
import random
import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from participant import Participant
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.cell.launcher import Graph
from straightcomp_ros.contract import COMMAND, DRIVER_STATE, ENCODER, STAGE_TRAJECTORY, TRIP
from straightcomp_ros.messages.joint_trajectory import MOST_POINTS
from straightcomp_ros.model.motion import Waypoint
from straightcomp_ros.runtime.graph_client import message_from_waypoints
from straightcomp_ros.runtime.streams import publisher, subscribe

pytestmark = pytest.mark.live

_APPLIED, _ENABLED = (DRIVER_STATE.layout.columns.index(name) for name in ("applied_current", "enabled"))


class Peer(Participant):
    """A stand-in for the controller."""

    def __init__(self) -> None:
        super().__init__("peer")
        self.samples: list[tuple[int, list[float]]] = []
        self.states: list[list[float]] = []
        self.current: float | None = 0.0
        self.command = publisher(self.node, COMMAND)
        self.trajectory = self.node.create_publisher(JointTrajectory, STAGE_TRAJECTORY, 10)
        self.trip = self.node.create_publisher(DiagnosticStatus, TRIP, 10)
        subscribe(self.node, ENCODER, self._on_sample)
        subscribe(self.node, DRIVER_STATE, lambda _, numbers: self.states.append(numbers))

    def _on_sample(self, stamp_ns, numbers):
        self.samples.append((stamp_ns, numbers))
        if self.current is not None:
            self.command(stamp_ns, self.current)

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def enable(self, on=True):
        return self.call(SetBool, "driver/enable", SetBool.Request(data=on))

    def amplifier_on(self):
        return bool(self.samples) and not math.isnan(self.samples[-1][1][3])


# A test's own process is slow to answer at times; the timeout under test has a test of its own.
PARAMETERS = {"stage.rate": 200, "simulated.command_timeout": 0.5}


@pytest.fixture(scope="module")
def domain(tmp_path_factory):
    """Where a driver is that several tests use."""
    domain = str(random.SystemRandom().randint(1, 101))
    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": domain}
    with Graph(tmp_path_factory.mktemp("driver") / "logs", environment) as graph:
        graph.start("driver", PARAMETERS)
        yield domain


@pytest.fixture
def peer(domain, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with Peer() as peer:
        # As the test before found it: off, and no fault.
        assert peer.enable(False).success
        peer.call(Trigger, "driver/reset_fault", Trigger.Request())
        peer.states.clear()
        yield peer


@pytest.fixture
def pushing_peer(graph):
    """Of a driver of its own: a constant current leaves the platform where the next test could not use it."""
    graph.start("driver", PARAMETERS)
    with Peer() as peer:
        yield peer


def test_samples_come_on_the_grid_of_the_sampling_clock(peer):
    peer.until(lambda: len(peer.samples) > 100)
    stamps = [stamp for stamp, _ in peer.samples]
    steps = {later - earlier for earlier, later in itertools.pairwise(stamps)}
    assert all(step % 5_000_000 == 0 for step in steps)


def test_without_commands_enable_is_refused(peer):
    peer.current = None
    # For longer than the timeout, beyond which no command of the test before is fresh.
    peer.spin(1.0)
    answer = peer.enable()
    assert not answer.success and "no fresh command" in answer.message


@pytest.mark.parametrize("current", [math.nan, math.inf, 2.0])
def test_a_command_that_is_not_finite_or_out_of_range_switches_off_and_latches(peer, current):
    peer.until(lambda: len(peer.samples) > 20)
    peer.until(lambda: peer.enable().success)
    peer.until(peer.amplifier_on)
    peer.current = current
    peer.until(lambda: not peer.amplifier_on())
    applied = [state[2] for state in peer.states]
    assert all(math.isfinite(value) and abs(value) <= 1.0 for value in applied)
    peer.current = 0.0
    peer.spin(0.2)
    refusal = peer.enable()
    assert not refusal.success and "latched" in refusal.message
    assert peer.call(Trigger, "driver/reset_fault", Trigger.Request()).success
    peer.until(lambda: peer.enable().success)


def test_commands_that_cease_switch_the_amplifier_off_until_a_reset(peer):
    peer.until(lambda: len(peer.samples) > 20)
    peer.until(lambda: peer.enable().success)
    peer.until(peer.amplifier_on)
    peer.current = None
    peer.until(lambda: not peer.amplifier_on())
    peer.current = 0.0
    peer.spin(0.2)
    refusal = peer.enable()
    assert not refusal.success and "no command for" in refusal.message


def test_one_command_stamped_an_hour_ahead_is_a_fault_and_a_reset_forgets_it(peer):
    peer.until(lambda: len(peer.samples) > 20)
    peer.until(lambda: peer.enable().success)
    peer.until(peer.amplifier_on)
    peer.command(peer.samples[-1][0] + 3600 * 10**9, 0.0)
    peer.until(lambda: not peer.amplifier_on())
    refusal = peer.enable()
    assert not refusal.success and "two_controllers" in refusal.message
    peer.call(Trigger, "driver/reset_fault", Trigger.Request())
    peer.until(lambda: peer.enable().success)
    peer.until(peer.amplifier_on)
    assert peer.enable(False).success
    peer.current = None
    # For longer than the timeout: a stamp in the future must not seem fresh.
    peer.spin(1.0)
    assert not peer.enable().success


def test_trajectories_that_no_stage_can_follow_are_refused_and_the_driver_goes_on(pushing_peer):
    peer, rest, second = pushing_peer, Waypoint(0, 0.0, 0.0), 10**9
    peer.until(lambda: len(peer.samples) > 20 and peer.trajectory.get_subscription_count())
    for *points, end in (
        [Waypoint(second, 1e300, 0.0)],
        [Waypoint(second, 1.7e308, 0.0), Waypoint(2 * second, -1.7e308, 0.0)],
        [Waypoint(1000, 1e-3, 0.0)],
        [Waypoint(k * 10**6, 0.0, 0.0) for k in range(1, MOST_POINTS + 1)],
    ):
        peer.trajectory.publish(message_from_waypoints([rest, *points, end]))
        seen = len(peer.samples)
        peer.until(lambda seen=seen: len(peer.samples) > seen + 20)
    assert {sample[0] for _, sample in peer.samples} == {0.0}
    peer.trajectory.publish(message_from_waypoints([rest, Waypoint(second, 1e-3, 0.0)]))
    peer.until(lambda: peer.samples[-1][1][0] == pytest.approx(1e-3))


@pytest.mark.parametrize("switch_off", ["disable", "trip"])
def test_once_the_amplifier_is_off_its_record_says_no_current_whatever_is_commanded(pushing_peer, switch_off):
    peer = pushing_peer
    peer.until(lambda: len(peer.samples) > 20)
    peer.current = 0.02
    peer.until(lambda: peer.enable().success)
    peer.until(lambda: peer.states and peer.states[-1][_APPLIED] > 0.01)
    if switch_off == "disable":
        assert peer.enable(False).success
    else:
        peer.trip.publish(DiagnosticStatus(message="somebody is in there"))
    peer.until(lambda: not peer.amplifier_on())
    peer.states.clear()
    peer.until(lambda: len(peer.states) > 20)
    # The first batch may have begun with the amplifier on.
    assert {state[_APPLIED] for state in peer.states if not state[_ENABLED]} == {0.0}
    assert not any(state[_ENABLED] for state in peer.states[8:])
