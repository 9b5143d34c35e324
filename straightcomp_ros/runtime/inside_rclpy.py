"""What the nodes use of rclpy that is not in its documentation: all of it is here, and its test says what has changed.

rclpy's own ways to publish and to take a message cost a 2 kHz loop 5 to 20 µs each, and a subscription cannot be waited
for outside an executor. Of a lifecycle node neither the state nor the service that changes it can be had.
"""

import time
from collections.abc import Callable, Mapping

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.subscription import Subscription

from straightcomp_ros.runtime.middleware import stamps_arrival


def raw_publish(publisher: Publisher) -> Callable[[bytes], None]:
    """A function that publishes a serialised message.

    It does not lock the publisher against being destroyed by another thread, and does not ask what it was given.
    """
    publish: Callable[[bytes], None] = publisher.handle.publish_raw
    return publish


def raw_take(subscription: Subscription) -> Callable[[], tuple[bytes, Mapping[str, int]] | None]:
    """A function that takes the next serialised message, with ``received_timestamp`` and ``source_timestamp`` in ns
    since the epoch; None where none waits.

    Cyclone DDS stamps the reception at the take (ros2/rmw_cyclonedds#167). A message came in after it was sent, after
    the last take that found none, and before this one: with such a middleware the earliest possible time is given.
    """
    take, kind = subscription.handle.take_message, subscription.msg_type
    if stamps_arrival():
        return lambda: take(kind, True)
    none_waited_ns = 0

    def take_and_date() -> tuple[bytes, Mapping[str, int]] | None:
        nonlocal none_waited_ns
        message = take(kind, True)
        if message is None:
            none_waited_ns = time.time_ns()
            return None
        data, info = message
        came_ns = min(max(info["source_timestamp"], none_waited_ns), time.time_ns())
        return data, {**info, "received_timestamp": came_ns}

    return take_and_date


def waiter(node: Node, subscription: Subscription) -> Callable[[int], None]:
    """A function that returns when a message is there, or after so many ns."""
    handle, wait_set = subscription.handle, rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)

    def wait(timeout_ns: int) -> None:
        # A wait leaves nothing in its set but what is ready.
        wait_set.clear_entities()
        wait_set.add_subscription(handle)
        wait_set.wait(timeout_ns)

    return wait


def lifecycle_state(node: LifecycleNode) -> str:
    """Name of the state that a lifecycle node is in, ``active`` for one."""
    return str(node._state_machine.current_state[1])


def state_service(node: LifecycleNode) -> Service:
    """The service by which others change the state of a lifecycle node."""
    service: Service = node._service_change_state
    return service
