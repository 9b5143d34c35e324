"""servo: driver, feedforward and controller in one process with one loop: read, look up, update, write, publish.

They are the same three nodes as in processes of their own, with the same names, parameters, topics and services. The
driver's loop calls the others' cycles as soon as it has samples, and they hand their streams over in memory.
"""

from straightcomp_ros.contract import COMMAND, ENCODER, REFERENCE
from straightcomp_ros.nodes.controller_node import CONTROLLER
from straightcomp_ros.nodes.driver_node import DRIVER
from straightcomp_ros.nodes.feedforward_node import FEEDFORWARD
from straightcomp_ros.runtime.intra_process import IntraProcess
from straightcomp_ros.runtime.runner import Managed, run_managed


def main(driver: Managed = DRIVER) -> int:
    """Entry point of `ros2 run straightcomp_ros servo_node`."""
    return run_managed((driver, FEEDFORWARD, CONTROLLER), IntraProcess((ENCODER, REFERENCE, COMMAND)), "servo")
