"""One client at a time commissions a machine."""

import time

import pytest
import rclpy
from rclpy.node import Node

from straightcomp_ros.contract import COMMISSIONING_CLIENT
from straightcomp_ros.runtime.commissioning_client import CommissioningSign
from straightcomp_ros.tuning.graph.waiting_client import GraphError, WaitingClient


class Other:
    """Another client, with a context of its own as in another process."""

    def __init__(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = Node(COMMISSIONING_CLIENT, context=self._context)
        CommissioningSign(self._node).report("acceptance")

    def end(self) -> None:
        if self._context.ok():
            self._node.destroy_node()
            rclpy.shutdown(context=self._context)


@pytest.fixture
def other():
    one = Other()
    yield one
    one.end()


def test_a_client_is_refused_with_what_another_one_does(other):
    with (
        WaitingClient(()) as client,
        pytest.raises(GraphError, match="machine: acceptance"),
    ):
        client.claim()


def test_a_client_may_begin_when_another_one_has_just_ended(other):
    with WaitingClient(()) as client:
        end = time.monotonic() + 30.0
        while not client._graph.commissioning and time.monotonic() < end:
            time.sleep(0.01)
        assert client._graph.commissioning
        other.end()
        client.claim()("connection")


def test_a_client_is_not_in_its_own_way():
    for _ in range(2):
        with WaitingClient(()) as client:
            client.claim()
