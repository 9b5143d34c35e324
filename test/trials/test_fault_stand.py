"""The stand for trials of faults: what it asks of the nodes' heartbeats and of their processes."""

import sys

from straightcomp_ros.cell.launcher import Graph
from straightcomp_ros.runtime.graph_watch import Heartbeats


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


def test_a_node_that_is_started_again_goes_on_with_its_log(tmp_path):
    with Graph(tmp_path) as graph:
        for word in ("first", "second"):
            graph.start_program("node", [sys.executable, "-c", f"print('{word}')"]).wait(60)
        assert graph.log("node").read_text().split() == ["first", "second"] and graph.exit_code("node") == 0
