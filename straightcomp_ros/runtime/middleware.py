"""The middleware that runs in this process, and our profile for it: sockets, and nothing in shared memory.

In shared memory a process that is killed or held up leaves locks and ports behind that stop the others for seconds; by
sockets it leaves nothing, and a message takes some 30 µs more, which cost no accuracy (docs/realtime.md).
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import rclpy

from straightcomp_ros.settings import middlewares


@contextmanager
def own_profile() -> Iterator[None]:
    """Participants that are made meanwhile get the profile, unless the user has set one.

    The discovery range is widened only beside a profile that keeps to this machine: with the wider range alone a node
    would look for nodes on other machines, and might command them.
    """
    before = dict(os.environ)
    ours = middlewares.profile_variables(rclpy.get_rmw_implementation_identifier(), before)
    os.environ.update(ours)
    try:
        yield
    finally:
        for name in ours:
            if name in before:
                os.environ[name] = before[name]
            else:
                del os.environ[name]


def stamps_arrival() -> bool:
    """Whether the middleware's time of reception is when a message came in, and not when it was taken."""
    return middlewares.middleware(rclpy.get_rmw_implementation_identifier()).stamps_arrival


def middleware_in_words() -> str:
    """Which middleware runs, with which profile, and what differs under it."""
    return f"middleware: {middlewares.description(rclpy.get_rmw_implementation_identifier(), os.environ)}"
