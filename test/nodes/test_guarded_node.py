"""What a callback's error on a foreign message or request does: a warning now and then, and no end of the node."""

from types import SimpleNamespace

import pytest
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node
from std_srvs.srv import SetBool

from straightcomp_ros.bags import BagError
from straightcomp_ros.runtime import guarded_node
from straightcomp_ros.runtime.guarded_node import GuardedNode, ThrottledWarning, refusal


class Logged:
    """Stands for a node; keeps its warnings."""

    def __init__(self):
        self.warnings = []

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)


def test_a_flood_of_wrong_messages_is_logged_every_five_seconds_with_the_number_of_the_others(monkeypatch):
    now, node = [100.0], Logged()
    monkeypatch.setattr(guarded_node, "time", SimpleNamespace(monotonic=lambda: now[0]))
    warning = ThrottledWarning(node, "a message is dropped")
    for _ in range(5000):
        warning.log(ValueError("x" * 100_000))
    now[0] += 5.0
    warning.log(KeyError())
    assert len(node.warnings) == 2 and max(map(len, node.warnings)) < 400
    assert "KeyError (and 4999 more" in node.warnings[1]


@pytest.fixture
def callbacks(monkeypatch):
    """The callbacks that reach rclpy, by topic or service, of a node that is never made."""
    found = {}
    monkeypatch.setattr(
        Node, "create_subscription", lambda self, kind, topic, callback: found.update({topic: callback})
    )
    monkeypatch.setattr(Node, "create_service", lambda self, kind, name, callback: found.update({name: callback}))
    monkeypatch.setattr(GuardedNode, "get_logger", lambda self: Logged().get_logger())
    return found


def failing(error):
    def callback(*_):
        raise error

    return callback


def test_an_error_of_a_callback_drops_the_message_or_refuses_the_request_and_one_of_the_machine_passes(callbacks):
    node = GuardedNode.__new__(GuardedNode)
    node.create_subscription(object, "trip", failing(ValueError("n/a")))
    node.create_service(SetBool, "enable", failing(KeyError("n/a")))
    node.create_service(SetBool, "start", failing(BagError("disk full")))
    callbacks["trip"](None)
    answer = callbacks["enable"](SetBool.Request(), SetBool.Response(success=True))
    assert not answer.success and "n/a" in answer.message
    with pytest.raises(BagError):
        callbacks["start"](SetBool.Request(), SetBool.Response())


def test_a_refusal_has_its_reason_also_where_the_response_has_a_result():
    result = refusal(SetParametersAtomically.Response(), "255 is no type").result
    assert not result.successful and result.reason == "255 is no type"
