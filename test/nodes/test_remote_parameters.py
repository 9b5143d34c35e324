"""Parameters of other nodes are collected even if a response is lost."""

from types import SimpleNamespace

from rcl_interfaces.msg import ListParametersResult, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.task import Future

from straightcomp_ros.runtime import graph_client

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
