"""Two stages in two namespaces on one machine, in one ROS domain."""

import os

import pytest
from parameters_of_tests import loop_parameters
from participant import Participant

from straightcomp_ros.cell.launcher import COMPOSED, executable_command, in_namespace
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.safety.faults import Fault

pytestmark = pytest.mark.keeps_time


@pytest.mark.parametrize("composed", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_two_graphs_in_two_namespaces_do_not_disturb_each_other(graph, tmp_path, composed):
    chosen, file = loop_parameters(), tmp_path / "parameters.yaml"
    chosen["driver"]["realtime.cpus"] = "loop"
    file.write_text(as_parameter_file(chosen))
    processes = {
        (stage, process): graph.start(
            f"{stage} {process}",
            {},
            file,
            command=[*executable_command(f"{process}_node"), "--ros-args", *in_namespace(stage)],
        )
        for stage in ("left", "right")
        for process in ([COMPOSED] if composed else chosen)
    }
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
        loops = [
            os.sched_getaffinity(processes[stage, COMPOSED if composed else "driver"].pid)
            for stage in ("left", "right")
        ]
        assert (os.cpu_count() or 1) < 2 or not loops[0] & loops[1]
        # Not one command of one went to the other: the left one sees no second controller, and goes on.
        left.spin(1.0)
        assert conditions() == (True, False)
