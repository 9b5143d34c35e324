"""Clients of the graph: parameters are collected even if a response is lost, and one client commissions at a time."""

import time
from types import SimpleNamespace

import pytest
import rclpy
from rcl_interfaces.msg import ListParametersResult, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.task import Future

from straightcomp_ros.contract import COMMISSIONING_CLIENT
from straightcomp_ros.runtime import graph_client
from straightcomp_ros.runtime.commissioning_client import CommissioningSign
from straightcomp_ros.tuning.graph.waiting_client import GraphError, WaitingClient

RATE = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=2000.0)


class LossyClient:
    """Its first request is never answered; it is there after the first look."""

    def __init__(self, node, name):
        self.looks = self.asked = 0

    def services_are_ready(self):
        self.looks += 1
        return self.looks > 1

    def list_parameters(self, prefixes, depth):
        self.asked += 1
        future = Future()
        if self.asked > 1:
            future.set_result(ListParameters.Response(result=ListParametersResult(names=["stage.rate"])))
        return future

    def get_parameters(self, names):
        future = Future()
        future.set_result(GetParameters.Response(values=[RATE] * len(names)))
        return future


def test_a_node_whose_response_was_lost_is_asked_again_until_it_has_answered(monkeypatch):
    monkeypatch.setattr(graph_client, "AsyncParameterClient", LossyClient)
    look, cancelled = [], []
    timer = SimpleNamespace(cancel=lambda: cancelled.append(True))
    node = SimpleNamespace(create_timer=lambda period, callback: look.append(callback) or timer)
    remote = graph_client.RemoteParameters(node, ["driver"])
    for _ in range(30):
        look[0]()
    assert remote.complete and remote.values == {"driver": {"stage.rate": 2000.0}}
    assert remote._clients["driver"].asked == 2 and cancelled


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
