"""Clients of the graph: parameters are collected even if a response is lost, and one client commissions at a time."""

from unittest.mock import Mock

import pytest
import rclpy
from rcl_interfaces.msg import ListParametersResult, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.task import Future
from waiting import comes_true

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
    node = Mock()
    remote = graph_client.RemoteParameters(node, ["driver"])
    ((_, look), _) = node.create_timer.call_args
    for _ in range(30):
        look()
    assert remote.complete and remote.values == {"driver": {"stage.rate": 2000.0}}
    assert remote._clients["driver"].asked == 2 and node.create_timer.return_value.cancel.called


def test_a_client_is_refused_with_what_another_one_does_and_may_begin_when_that_has_just_ended():
    # With a context of its own, as in another process.
    context = rclpy.Context()
    rclpy.init(context=context)
    other = Node(COMMISSIONING_CLIENT, context=context)
    CommissioningSign(other).report("acceptance")
    with WaitingClient(()) as client, pytest.raises(GraphError, match="machine: acceptance"):
        client.claim()
    with WaitingClient(()) as client:
        assert comes_true(lambda: client.commissioning.doing)
        other.destroy_node()
        rclpy.shutdown(context=context)
        client.claim()("connection")
    # Nor is a client in its own way.
    with WaitingClient(()) as client:
        client.claim()
