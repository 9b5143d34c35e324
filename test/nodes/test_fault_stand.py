"""The stand for trials of faults: what it asks of the nodes' heartbeats and of their processes."""

from straightcomp_ros.nodes.fault_stand import Stand
from straightcomp_ros.nodes.heartbeats import Heartbeats


class Deaf:
    """In the place of a node: nothing comes in, no timer fires."""

    def create_subscription(self, kind, topic, callback, depth):
        self.receive = callback

    def create_timer(self, period, callback):
        pass


class Beat:
    name, message = "logger", "active"


def test_a_node_started_anew_is_silent_until_its_next_heartbeat():
    node = Deaf()
    heartbeats = Heartbeats(node, ["logger"])
    node.receive(Beat())
    assert heartbeats.in_state("active")
    heartbeats.forget("logger")
    assert heartbeats.silent() == ["logger"]
    node.receive(Beat())
    assert heartbeats.in_state("active")


def test_the_exit_code_of_a_node_may_be_asked_for_again():
    stand = object.__new__(Stand)
    stand.processes, stand._codes = {"logger": 7}, {}
    answers = [None, 1]
    stand._ask = lambda request: {"code": answers.pop(0)}
    assert [stand.exit_code("logger") for _ in range(3)] == [None, 1, 1]
