"""The nodes' diagnostics as an aggregator gets them."""

import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from straightcomp_ros.contract import DIAGNOSTICS
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.timing.node_timing import LOST, SAMPLES

pytestmark = pytest.mark.live


class Aggregator:
    """Keeps all that is published on diagnostics, by the node's name."""

    def __init__(self):
        self.node = Node("aggregator")
        self.found: dict[str, list[DiagnosticStatus]] = {}
        self.node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, 100)

    def _on_diagnostics(self, message):
        assert message.header.stamp.sec > 0
        for status in message.status:
            self.found.setdefault(status.name, []).append(status)

    def until(self, condition, seconds=90.0):
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, f"it never came true: {self.found}"
            rclpy.spin_once(self.node, timeout_sec=0.05)


@pytest.fixture
def aggregator():
    rclpy.init()
    aggregator = Aggregator()
    yield aggregator
    aggregator.node.destroy_node()
    rclpy.shutdown()


def test_a_node_in_a_namespace_reports_on_the_common_topic_with_its_namespace_in_the_status(aggregator):
    node = Node("reporter", namespace="/line_3")
    diagnostics = Diagnostics(node, lambda: {SAMPLES: 1})
    try:
        aggregator.until(lambda: node.count_subscribers("/diagnostics") > 0)
        diagnostics._collect()
        diagnostics._publish()
        aggregator.until(lambda: "line_3/reporter" in aggregator.found)
    finally:
        node.destroy_node()


def test_levels_go_up_at_once_and_come_down_when_five_reports_were_clean(aggregator):
    values = {SAMPLES: 0, LOST: 0}
    node = Node("reporter")
    diagnostics = Diagnostics(node, lambda: values, "bench 7")

    def reported(error=""):
        """Level and words of the next report."""
        values["error"] = error
        seen = aggregator.found.setdefault("reporter", [])
        before = len(seen)
        values[SAMPLES] += 2000
        diagnostics._collect()
        diagnostics._publish()
        aggregator.until(lambda: len(seen) > before)
        return seen[-1].level, seen[-1].message

    try:
        aggregator.until(lambda: aggregator.node.get_publishers_info_by_topic("/diagnostics"))
        aggregator.until(lambda: node.count_subscribers("/diagnostics") > 0)
        assert reported() == (DiagnosticStatus.OK, "running")
        assert reported("coil burnt") == (DiagnosticStatus.ERROR, "coil burnt")
        assert [reported()[0] for _ in range(5)] == [*[DiagnosticStatus.WARN] * 4, DiagnosticStatus.OK]
        values[LOST] += 3
        assert reported() == (DiagnosticStatus.WARN, "3 samples lost in the last second")
        assert {status.hardware_id for status in aggregator.found["reporter"]} == {"bench 7"}
    finally:
        node.destroy_node()
