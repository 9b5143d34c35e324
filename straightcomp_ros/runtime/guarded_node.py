"""A node that foreign messages and requests cannot end.

Any program on the machine may publish on our topics and call our services. Without a guard the executor passes the
exception of a callback on, and the process ends with the amplifier on.
"""

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from straightcomp_ros.bags import BagError
from straightcomp_ros.hardware.interface import HardwareError

RUN_FAILURES = (BagError, HardwareError, OSError)
"""Raised while a node runs, when a bag, the machine or a file fails: no fault of a message, so they end the node."""
_LOG_EVERY_S = 5.0
_LONGEST_REASON = 200


class GuardedNode(Node):
    """Its callbacks drop a message, and refuse a request, that they cannot handle; the log says so every 5 s at most.

    :data:`RUN_FAILURES` pass. Timers are not guarded: their errors are the node's own.
    """

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[[Any], None], *more: Any, **options: Any
    ) -> Any:
        """As `rclpy.node.Node.create_subscription`."""
        dropped = Complaints(self, f"a message on '{topic}' is dropped")

        def receive(message: Any) -> None:
            try:
                callback(message)
            except RUN_FAILURES:
                raise
            except Exception as error:
                dropped.say(error)

        return super().create_subscription(kind, topic, receive, *more, **options)

    def create_service(
        self, kind: Any, name: str, callback: Callable[[Any, Any], Any], *more: Any, **options: Any
    ) -> Any:
        """As `rclpy.node.Node.create_service`."""
        refused = Complaints(self, f"a request of '{name}' is refused")

        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except RUN_FAILURES:
                raise
            except Exception as error:
                return refusal(kind.Response(), refused.say(error))

        return super().create_service(kind, name, answer, *more, **options)


class Complaints:
    """Warns in ``node``'s log, at most once in 5 s: a flood of messages must not fill the disk."""

    def __init__(self, node: Node, what: str) -> None:
        self._node, self._what, self._next, self._unsaid = node, what, 0.0, 0

    def say(self, error: object) -> str:
        """Log the ``error``, and how many were not logged before it; returns it in words."""
        reason = (str(error) or type(error).__name__)[:_LONGEST_REASON]
        now = time.monotonic()
        if now < self._next:
            self._unsaid += 1
            return reason
        more = f" (and {self._unsaid} more since the last such warning)" if self._unsaid else ""
        self._node.get_logger().warning(f"{self._what}: {reason}{more}")
        self._next, self._unsaid = now + _LOG_EVERY_S, 0
        return reason


def refusal(response: Any, reason: str) -> Any:
    """``response`` as a refusal with this reason, as far as its type has room for one."""
    if hasattr(response, "success"):
        response.success = False
    for one in (response, getattr(response, "result", None)):
        for field in ("message", "reason"):
            if hasattr(one, field):
                setattr(one, field, reason)
    return response
