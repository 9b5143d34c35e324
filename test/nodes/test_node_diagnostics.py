"""A node's diagnostics as an aggregator gets them; what the nodes report is in test_lifecycle.py."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from participant import Participant
from rclpy.node import Node

from straightcomp_ros.contract import DIAGNOSTICS
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.timing.node_timing import LOST, SAMPLES

pytestmark = pytest.mark.live


@pytest.fixture
def aggregator():
    with Participant("aggregator") as aggregator:
        aggregator.found = []
        aggregator.node.create_subscription(
            DiagnosticArray, DIAGNOSTICS, lambda message: aggregator.found.extend(message.status), 100
        )
        yield aggregator


def reported(aggregator, diagnostics):
    """The next report."""
    before = len(aggregator.found)
    diagnostics._collect()
    diagnostics._publish()
    aggregator.until(lambda: len(aggregator.found) > before)
    return aggregator.found[-1]


def connected(aggregator, node):
    aggregator.until(lambda: aggregator.node.get_publishers_info_by_topic("/diagnostics"))
    aggregator.until(lambda: node.count_subscribers("/diagnostics") > 0)


def test_a_node_in_a_namespace_reports_on_the_common_topic_with_its_namespace_in_the_status(aggregator):
    node = Node("reporter", namespace="/line_3")
    diagnostics = Diagnostics(node, lambda: {SAMPLES: 1})
    connected(aggregator, node)
    assert reported(aggregator, diagnostics).name == "line_3/reporter"
    node.destroy_node()


def test_levels_go_up_at_once_and_come_down_when_five_reports_were_clean(aggregator):
    node, values = Node("reporter"), {SAMPLES: 0, LOST: 0}
    diagnostics = Diagnostics(node, lambda: values, "bench 7")
    connected(aggregator, node)

    def level(error=""):
        values.update({"error": error, SAMPLES: values[SAMPLES] + 2000})
        status = reported(aggregator, diagnostics)
        return status.level, status.message

    assert level() == (DiagnosticStatus.OK, "running")
    assert level("coil burnt") == (DiagnosticStatus.ERROR, "coil burnt")
    assert [level()[0] for _ in range(5)] == [*[DiagnosticStatus.WARN] * 4, DiagnosticStatus.OK]
    values[LOST] += 3
    assert level() == (DiagnosticStatus.WARN, "3 samples lost in the last second")
    assert {status.hardware_id for status in aggregator.found} == {"bench 7"}
    node.destroy_node()
