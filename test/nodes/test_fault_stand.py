"""The stand for trials of faults: what it asks of the nodes' heartbeats and of their processes."""

from straightcomp_ros.runtime.heartbeats import Heartbeats
from straightcomp_ros.trials.faults.nursery_client import Nursery


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
    nursery = object.__new__(Nursery)
    nursery._codes, answers = {}, [None, 1]
    nursery._ask = lambda request: {"code": answers.pop(0)}
    assert [nursery.exit_code(7) for _ in range(3)] == [None, 1, 1]
