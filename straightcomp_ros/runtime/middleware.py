"""The middleware of this process, and our profile for it: sockets, and no shared memory.

A process that is killed or suspended leaves locks and ports in shared memory that block the others for seconds. With
sockets it leaves nothing; a message then takes about 30 µs more, which costs no accuracy (docs/realtime.md).
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import rclpy

from straightcomp_ros.parameters import middlewares


@contextmanager
def own_profile() -> Iterator[None]:
    """Give the profile to participants made inside this context, unless the user has set one.

    The discovery range is widened only together with a profile that stays on this computer: with the wider range alone
    a node would look for nodes on other computers, and might command them.
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


def middleware_in_words() -> str:
    """Name and profile of the running middleware, and what differs under it, for a log."""
    return f"middleware: {middlewares.description(rclpy.get_rmw_implementation_identifier(), os.environ)}"
