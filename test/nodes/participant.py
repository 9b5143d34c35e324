"""Another participant of the graph, in the test's process: it waits, calls services, knows the amplifier's state."""

import contextlib
import math
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.contract import ENCODER, SAFETY_STATE, STAGE_TRAJECTORY, TRIP
from straightcomp_ros.runtime.graph_client import message_from_waypoints
from straightcomp_ros.runtime.safety_panel import LATCHED, SafetyState
from straightcomp_ros.runtime.streams import message_class, stream_qos

PATIENCE_S = 90.0


def subscribe(node, stream, callback):
    """Call ``callback(stamp_ns, numbers)`` for each message of a stream as it arrives."""
    kind, unpack = message_class(stream.layout.type_name), stream.layout.unpack
    node.create_subscription(kind, stream.topic, lambda data: callback(*unpack(data)), stream_qos(), raw=True)


class Participant:
    """A node in this process, while it is entered as a context. ``safety`` has the driver's safety states."""

    def __init__(self, name="participant", namespace=""):
        self._first = not rclpy.ok()
        if self._first:
            rclpy.init()
        self.node = Node(name, namespace=namespace)
        self._clients = {}
        self.safety = [SafetyState()]
        self.node.create_subscription(
            DiagnosticStatus, SAFETY_STATE, lambda message: self.safety.append(SafetyState.of(message)), LATCHED
        )
        self._trip = self.node.create_publisher(DiagnosticStatus, TRIP, 10)
        self._trajectory = self.node.create_publisher(JointTrajectory, STAGE_TRAJECTORY, 10)

    def until(self, condition, seconds=PATIENCE_S):
        end = time.monotonic() + seconds
        # Asked once in each turn: a condition may be a request, and a second one after it was granted may be refused.
        while not condition():
            assert time.monotonic() < end, "it never came true"
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def spin(self, seconds):
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end)

    def call(self, kind, name, request=None):
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        client = self._clients[name]
        self.until(client.service_is_ready)
        future = client.call_async(request or kind.Request())
        self.until(future.done)
        return future.result()

    def trigger(self, name):
        return self.call(Trigger, name)

    def enable(self, on=True):
        return self.call(SetBool, "driver/enable", SetBool.Request(data=on))

    def trip(self, reason="the door is open"):
        self.until(self._trip.get_subscription_count)
        self._trip.publish(DiagnosticStatus(name="whatever", message=reason))

    def move(self, points, begin_s=0):
        message = message_from_waypoints(points)
        message.header.stamp.sec = begin_s
        self.until(self._trajectory.get_subscription_count)
        self._trajectory.publish(message)

    def amplifier_on(self):
        return self.safety[-1].amplifier_on

    def switch_on(self):
        self.until(lambda: self.enable().success)
        self.until(self.amplifier_on)

    def state(self, node):
        return self.call(GetState, f"{node}/get_state").current_state.label

    def change(self, node, label):
        request = ChangeState.Request()
        request.transition.label = label
        return self.call(ChangeState, f"{node}/change_state", request).success

    def parameter(self, node, name):
        answer = self.call(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=[name]))
        return parameter_value_to_python(answer.values[0])

    def set(self, node, values):
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParametersAtomically.Request(parameters=parameters)
        return self.call(SetParametersAtomically, f"{node}/set_parameters_atomically", request).result

    def received(self, stream, count=20):
        """Some messages of a stream: this process cannot read all 2000 a second for long."""
        found, before = [], set(self.node.subscriptions)
        subscribe(self.node, stream, lambda _, numbers: found.append(numbers))
        self.until(lambda: len(found) >= count)
        for subscription in set(self.node.subscriptions) - before:
            self.node.destroy_subscription(subscription)
        return found

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.node.destroy_node()
        if self._first:
            rclpy.shutdown()


class Follower(Participant):
    """Has all samples, and sees by them whether the amplifier is on."""

    def __init__(self, name):
        super().__init__(name)
        self.samples = []
        subscribe(self.node, ENCODER, self.on_sample)

    def on_sample(self, stamp_ns, numbers):
        self.samples.append((stamp_ns, numbers))

    @property
    def x(self):
        return self.samples[-1][1][0]

    def amplifier_on(self):
        return len(self.samples) > 20 and math.isfinite(self.samples[-1][1][3])


@contextlib.contextmanager
def spun(node):
    """The node takes its turns while a participant is spun, and is destroyed afterwards."""
    rclpy.get_global_executor().add_node(node)
    yield node
    rclpy.get_global_executor().remove_node(node)
    node.destroy_node()
