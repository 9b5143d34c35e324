"""Two stages in two namespaces on one machine, in one ROS domain."""

import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from std_srvs.srv import SetBool

from straightcomp_ros.cell.launcher import executable_command
from straightcomp_ros.contract import SAFETY_STATE, TRIP
from straightcomp_ros.runtime.safety_panel import LATCHED

pytestmark = pytest.mark.keeps_time

PATIENCE_S = 60.0


def test_two_graphs_in_two_namespaces_do_not_disturb_each_other(graph, forgiving):
    for stage in ("left", "right"):
        for node, parameters in (
            ("driver", forgiving),
            ("feedforward", {}),
            ("controller", {"sample_timeout": 30.0}),
        ):
            command = [*executable_command(f"{node}_node"), "--ros-args", "-r", f"__ns:=/{stage}"]
            graph.start(f"{stage} {node}", parameters, command=command)
    rclpy.init()
    node = Node("observer")
    try:
        conditions = {}

        def until(condition):
            end = time.monotonic() + PATIENCE_S
            while not condition():
                assert time.monotonic() < end, f"it never came true: {conditions}"
                rclpy.spin_once(node, timeout_sec=0.05)

        def enabled(stage):
            client = node.create_client(SetBool, f"/{stage}/driver/enable")
            until(client.service_is_ready)
            future = client.call_async(SetBool.Request(data=True))
            until(future.done)
            node.destroy_client(client)
            return future.result().success

        for stage in ("left", "right"):

            def note(message, stage=stage):
                conditions[stage] = (message.name, {value.key: value.value for value in message.values}["condition"])

            node.create_subscription(DiagnosticStatus, f"/{stage}/{SAFETY_STATE}", note, LATCHED)
        trip = node.create_publisher(DiagnosticStatus, f"/right/{TRIP}", 10)
        until(lambda: enabled("left"))
        until(lambda: conditions.get("left") == ("", "on") and conditions.get("right") == ("", "off"))
        until(lambda: enabled("right"))
        until(lambda: conditions["right"] == ("", "on"))
        trip.publish(DiagnosticStatus(name="tripped", message="the right one only"))
        until(lambda: conditions["right"] == ("tripped", "fault"))
        # Not one command of one went to the other: the left one sees no second controller, and goes on.
        end = time.monotonic() + 1.0
        until(lambda: time.monotonic() > end)
        assert conditions["left"] == ("", "on")
    finally:
        node.destroy_node()
        rclpy.shutdown()
