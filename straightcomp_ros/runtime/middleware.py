"""This process's profile of Fast DDS: sockets, and nothing in shared memory.

In shared memory a process that is killed or held up leaves locks and ports behind that stop the others for seconds; by
sockets it leaves nothing, and a message takes some 30 µs more, which cost no accuracy (docs/realtime.md).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import rclpy

from straightcomp_ros.settings.share import share_path

PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Where Fast DDS finds its settings, by its old name and its new one; who sets one keeps his own."""
RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


@contextmanager
def own_profile() -> Iterator[None]:
    """Participants that are made meanwhile get the profile.

    Another middleware than Fast DDS knows none of this, and stays as the user has set it up. (With the wider discovery
    range it would look for nodes on other machines, and might command them.)
    """
    if any(name in os.environ for name in PROFILE_VARIABLES) or not uses_fast_dds():
        yield
    elif os.environ.get(RANGE_VARIABLE) == "LOCALHOST":
        # For LOCALHOST rmw_fastrtps adds shared memory, whatever the profile says. This one is for this machine anyway.
        with _set(RANGE_VARIABLE, "SYSTEM_DEFAULT"), _set_profiles("config/fastdds_loopback.xml"):
            yield
    else:
        with _set_profiles("config/fastdds.xml"):
            yield


def uses_fast_dds() -> bool:
    """Whether the middleware that ROS 2 has chosen here reads a profile of Fast DDS."""
    return rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps")


@contextmanager
def _set_profiles(name: str) -> Iterator[None]:
    file = str(share_path(name))
    with _set(PROFILE_VARIABLES[0], file), _set(PROFILE_VARIABLES[1], file):
        yield


@contextmanager
def _set(variable: str, value: str) -> Iterator[None]:
    before = os.environ.get(variable)
    os.environ[variable] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[variable]
        else:
            os.environ[variable] = before
