"""A client of the running nodes: switch the amplifier on, make strokes, and switch it off again.

ros2 launch straightcomp_ros servo.launch.py    # driver, feedforward and controller
python examples/stroke_client.py 3
"""

import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.contract import SAFETY_STATE, STAGE_TRAJECTORY
from straightcomp_ros.model.motion import MotionParameters, cycles
from straightcomp_ros.runtime.graph_client import message_from_waypoints
from straightcomp_ros.runtime.safety_panel import LATCHED


class StrokeClient(Node):
    def __init__(self) -> None:
        super().__init__("stroke_client")
        self.safety = DiagnosticStatus()  # its name is that of the latched fault, empty without one
        self.create_subscription(DiagnosticStatus, SAFETY_STATE, lambda state: setattr(self, "safety", state), LATCHED)
        self._trajectory = self.create_publisher(JointTrajectory, STAGE_TRAJECTORY, 10)
        self._enable = self.create_client(SetBool, "driver/enable")

    def switch(self, on: bool) -> None:
        if not self._enable.wait_for_service(timeout_sec=10.0):
            sys.exit("no driver within 10 s: do both have the same ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE?")
        answer = self._enable.call_async(SetBool.Request(data=on))
        rclpy.spin_until_future_complete(self, answer, timeout_sec=10.0)
        if not answer.done() or not answer.result().success:
            sys.exit(answer.result().message if answer.done() else "the driver does not answer")

    def move(self, motion: MotionParameters, count: int) -> None:
        waypoints = cycles(motion, count)
        self._trajectory.publish(message_from_waypoints(waypoints))
        end = time.monotonic() + waypoints[-1].time_ns * 1e-9
        while time.monotonic() < end:
            rclpy.spin_once(self, timeout_sec=0.1)
            if self.safety.name:
                sys.exit(f"amplifier off: {self.safety.name}: {self.safety.message}")


if __name__ == "__main__":
    if len(sys.argv) != 2 or not sys.argv[1].isdecimal() or not 1 <= int(sys.argv[1]) <= 1000:
        sys.exit(f"{__doc__}\nThe number is that of the strokes, each forward and back: 1 to 1000.")
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # after Ctrl-C the amplifier can still be switched off
    client = StrokeClient()
    try:
        client.switch(True)
        client.move(MotionParameters(), int(sys.argv[1]))  # of the shipped stage
    except KeyboardInterrupt:
        sys.exit("interrupted")
    finally:
        client.switch(False)
