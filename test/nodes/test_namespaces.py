"""Two stages in two namespaces on one machine, in one ROS domain."""

import pytest
from parameters_of_tests import loop_parameters
from participant import Participant

from straightcomp_ros.cell.launcher import executable_command
from straightcomp_ros.safety.faults import Fault

pytestmark = pytest.mark.keeps_time


def test_two_graphs_in_two_namespaces_do_not_disturb_each_other(graph):
    for stage in ("left", "right"):
        for node, parameters in loop_parameters().items():
            command = [*executable_command(f"{node}_node"), "--ros-args", "-r", f"__ns:=/{stage}"]
            graph.start(f"{stage} {node}", parameters, command=command)
    with Participant(namespace="left") as left, Participant(namespace="right") as right:

        def conditions():
            left.spin(0.1)
            right.spin(0.1)
            return left.safety[-1].amplifier_on, right.safety[-1].amplifier_on

        left.switch_on()
        left.until(lambda: conditions() == (True, False))
        right.switch_on()
        right.trip("the right one only")
        right.until(lambda: right.safety[-1].code == Fault.TRIPPED.code)
        # Not one command of one went to the other: the left one sees no second controller, and goes on.
        left.spin(1.0)
        assert conditions() == (True, False)
