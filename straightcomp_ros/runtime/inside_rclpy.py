"""The undocumented interfaces of rclpy that the nodes use: all are in this file, and its test shows what has changed.

The documented ways to publish and to take a message cost a 2 kHz loop 5 to 20 µs each, and only an executor can wait
for a subscription. A lifecycle node gives no access to its state or to the service that changes it.
"""

import ctypes
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import rclpy
from rclpy.action.server import ActionServer, GoalEvent, ServerGoalHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.subscription import Subscription

from straightcomp_ros.parameters.middlewares import middleware


def raw_publish(publisher: Publisher) -> Callable[[bytes], None]:
    """A function that publishes a serialised message.

    It does not lock the publisher against destruction by another thread, and does not check its argument.
    """
    publish: Callable[[bytes], None] = publisher.handle.publish_raw
    return publish


class _SerializedMessage(ctypes.Structure):
    """rcl_serialized_message_t"""

    _fields_ = (
        ("buffer", ctypes.c_char_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", ctypes.c_void_p * 5),
    )


def unlocked_publish(publisher: Publisher) -> Callable[[bytes], None]:
    """Like :func:`raw_publish`, for a thread: rclpy's function would keep the interpreter lock, and with it the loop
    from running, for the 100 µs that the middleware takes. OSError: the middleware refused the message."""
    publish = ctypes.CDLL("librcl.so").rcl_publish_serialized_message
    publish.argtypes = (ctypes.c_void_p,) * 3
    handle = publisher.handle.pointer

    def publish_serialized(data: bytes) -> None:
        message = _SerializedMessage(data, len(data), len(data))
        if code := publish(handle, ctypes.byref(message), None):
            raise OSError(f"a message on '{publisher.topic_name}' could not be sent: rcl's error {code}")

    return publish_serialized


def raw_take(subscription: Subscription) -> Callable[[], tuple[bytes, Mapping[str, int]] | None]:
    """A function that takes the next serialised message, with ``received_timestamp`` and ``source_timestamp`` in ns
    since the epoch; it returns None if there is no message.

    Cyclone DDS stamps the reception at the take (ros2/rmw_cyclonedds#167). A message arrived after it was sent, after
    the subscription began and the last take that found none, and before this one: for such a middleware the earliest
    possible time is returned.
    """
    take, kind = subscription.handle.take_message, subscription.msg_type
    if middleware(rclpy.get_rmw_implementation_identifier()).stamps_arrival:
        return lambda: take(kind, True)
    none_waited_ns = time.time_ns()

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


def publisher_count(node: Node, topic: str) -> Callable[[], int]:
    """A function that counts the publishers of the topic with this full name, for a thread: rclpy's function takes
    100 µs, and keeps the interpreter lock. OSError: the middleware does not answer."""
    count = ctypes.CDLL("librcl.so").rcl_count_publishers
    count.argtypes = (ctypes.c_void_p, ctypes.c_char_p, ctypes.POINTER(ctypes.c_size_t))
    handle, name = node.handle.pointer, topic.encode()

    def counted() -> int:
        number = ctypes.c_size_t()
        if code := count(handle, name, ctypes.byref(number)):
            raise OSError(f"the publishers of '{topic}' could not be counted: rcl's error {code}")
        return number.value

    return counted


def waiter(node: Node, subscription: Subscription) -> Callable[[int], None]:
    """A function ``wait(timeout_ns)`` that returns when a message has arrived, or after that time."""
    handle, wait_set = subscription.handle, rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)

    def wait(timeout_ns: int) -> None:
        # A wait leaves only ready entities in its set.
        wait_set.clear_entities()
        wait_set.add_subscription(handle)
        wait_set.wait(timeout_ns)

    return wait


def withdraw(node: Node, kind: str, entity: Any) -> Callable[[], None]:
    """Take a client, subscription or publisher from its node; returns the function that destroys it, to be
    called after the executor's next look at the node.

    An EventsExecutor may have an event of the entity in its queue, and crashes if it is destroyed before the executor
    has dropped it (ros2/rclpy#1644): after some tens of transitions of a lifecycle node.
    """
    destroy: Callable[[], None] = entity.destroy
    entity.destroy = lambda: None
    getattr(node, f"destroy_{kind}")(entity)
    return destroy


def lifecycle_state(node: LifecycleNode) -> str:
    """Name of a lifecycle node's current state, e.g. ``active``."""
    return str(node._state_machine.current_state[1])


def state_service(node: LifecycleNode) -> Service:
    """The service that changes the state of a lifecycle node."""
    service: Service = node._service_change_state
    return service


def set_executing(handle: ServerGoalHandle) -> None:
    """Show a goal as being executed, schedule nothing: a coroutine that is not done keeps an EventsExecutor busy."""
    handle._update_state(GoalEvent.EXECUTE)


def execute(server: ActionServer, node: Node, handle: ServerGoalHandle, finished: Callable[[Any], Any]) -> None:
    """Have ``server`` send what ``finished`` makes of a goal: as a task of the executor, or at once where that is gone,
    at the end of a process."""
    if node.executor is not None:
        server.notify_execute(handle, finished)
        return
    with suppress(StopIteration):
        server._execute_goal(finished, handle).send(None)
