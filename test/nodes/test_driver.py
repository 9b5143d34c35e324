"""The driver as others see it: over its topics and services."""

import itertools
import math
import time

import pytest
import rclpy
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from straightcomp_ros.contract import COMMAND, DRIVER_STATE, ENCODER
from straightcomp_ros.nodes.streams import publisher, subscribe


class Peer:
    """A stand-in for the controller."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = Node("peer")
        self.samples: list[tuple[int, list[float]]] = []
        self.states: list[list[float]] = []
        self.current: float | None = 0.0
        self._command = publisher(self.node, COMMAND)
        subscribe(self.node, ENCODER, self._on_sample)
        subscribe(self.node, DRIVER_STATE, lambda _, numbers: self.states.append(numbers))

    def _on_sample(self, stamp_ns, numbers):
        self.samples.append((stamp_ns, numbers))
        if self.current is not None:
            self._command(stamp_ns, self.current)

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def until(self, condition, seconds=60.0):
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.05)
        assert condition()

    def call(self, kind, name, request):
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(timeout_sec=60)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def enable(self, on=True):
        return self.call(SetBool, "driver/enable", SetBool.Request(data=on))

    def amplifier_on(self):
        return bool(self.samples) and not math.isnan(self.samples[-1][1][3])


@pytest.fixture
def peer(graph):
    # A test's own process is slow to answer at times; the timeout under test has a test of its own.
    graph.start("driver", {"simulated.rate": 200, "simulated.command_timeout": 0.5})
    peer = Peer()
    try:
        yield peer
    finally:
        peer.node.destroy_node()
        rclpy.shutdown()


def test_samples_come_on_the_grid_of_the_sampling_clock(peer):
    peer.until(lambda: len(peer.samples) > 100)
    stamps = [stamp for stamp, _ in peer.samples]
    steps = {later - earlier for earlier, later in itertools.pairwise(stamps)}
    assert all(step % 5_000_000 == 0 for step in steps)


def test_without_commands_enable_is_refused(peer):
    peer.current = None
    peer.until(lambda: len(peer.samples) > 10)
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


def test_disabling_switches_the_amplifier_off(peer):
    peer.until(lambda: len(peer.samples) > 20)
    peer.until(lambda: peer.enable().success)
    peer.until(peer.amplifier_on)
    assert peer.enable(False).success
    peer.until(lambda: not peer.amplifier_on())
