"""Two stages in two namespaces on one machine, in one ROS domain."""

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from parameters_of_tests import loop_parameters
from participant import Participant
from std_srvs.srv import SetBool

from straightcomp_ros.cell.launcher import executable_command
from straightcomp_ros.contract import SAFETY_STATE, TRIP
from straightcomp_ros.runtime.safety_panel import LATCHED, SafetyState
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.safety.state_machine import Condition

pytestmark = pytest.mark.keeps_time


def test_two_graphs_in_two_namespaces_do_not_disturb_each_other(graph):
    for stage in ("left", "right"):
        for node, parameters in loop_parameters().items():
            command = [*executable_command(f"{node}_node"), "--ros-args", "-r", f"__ns:=/{stage}"]
            graph.start(f"{stage} {node}", parameters, command=command)
    with Participant("observer") as observer:
        states = {stage: SafetyState(Condition.FAULT) for stage in ("left", "right")}

        def enabled(stage):
            return observer.call(SetBool, f"/{stage}/driver/enable", SetBool.Request(data=True)).success

        for stage in ("left", "right"):

            def note(message, stage=stage):
                states[stage] = SafetyState.of(message)

            observer.node.create_subscription(DiagnosticStatus, f"/{stage}/{SAFETY_STATE}", note, LATCHED)
        trip = observer.node.create_publisher(DiagnosticStatus, f"/right/{TRIP}", 10)
        observer.until(lambda: enabled("left"))
        observer.until(lambda: states["left"].amplifier_on and states["right"].condition is Condition.OFF)
        observer.until(lambda: enabled("right"))
        observer.until(lambda: states["right"].amplifier_on)
        trip.publish(DiagnosticStatus(name="tripped", message="the right one only"))
        observer.until(lambda: states["right"].code == Fault.TRIPPED.code)
        # Not one command of one went to the other: the left one sees no second controller, and goes on.
        observer.spin(1.0)
        assert states["left"].amplifier_on
