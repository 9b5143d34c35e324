"""This process's profile of Fast DDS: `config/fastdds.xml`, and a place of its own among the participants.

Who commands or watches the graph talks with it over loopback sockets (`config/fastdds_loopback.xml`): they cost a
message some 50 µs more, but whoever is killed or held up, on either side, leaves nothing there that stops the other.

In shared memory it does. Fast DDS takes the first place whose ports are free, which is that of the node that was just
killed, with the same numbers of ports in shared memory. A writer that has not noticed the death yet opens the port of
that number anew, takes it from the new node thereby, and that for each message (eProsima/Fast-DDS issues 2398 and
5053): the loop stands still. So each process takes a place where no port lies, or, after many a killed process, one
whose port nobody has open any more.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rclpy

from straightcomp_ros.share import share_path
from straightcomp_ros.shared_memory import mapped

PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
"""Where Fast DDS finds its settings; who sets it keeps his own."""
_RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_PLACES = 32
"""As many as find each other without multicast."""
_PORT_BASE, _PER_DOMAIN, _USER_UNICAST, _PER_PARTICIPANT = 7400, 250, 11, 2
"""RTPS 2.2, 9.6.1.1."""


@contextmanager
def own_profile(by_sockets: bool = False, shared_memory: Path = Path("/dev/shm")) -> Iterator[None]:
    """Participants that are made meanwhile get the profile.

    Enter it before anything is removed from shared memory: what a killed node left there marks its place.

    Another middleware than Fast DDS knows none of this, and stays as the user has set it up. (With the wider discovery
    range it would look for nodes on other machines, and might command them.)

    Args:
        by_sockets: keep out of shared memory, where ROS_AUTOMATIC_DISCOVERY_RANGE keeps all traffic on this machine.
        shared_memory: folder with Fast DDS's files.
    """
    if PROFILE_VARIABLE in os.environ or not uses_fast_dds():
        yield
    elif by_sockets and os.environ.get(_RANGE_VARIABLE) == "LOCALHOST":
        # For LOCALHOST rmw_fastrtps adds shared memory, whatever the profile says. This one is for this machine anyway.
        profile = str(share_path("config/fastdds_loopback.xml"))
        with _set(_RANGE_VARIABLE, "SYSTEM_DEFAULT"), _set(PROFILE_VARIABLE, profile):
            yield
    else:
        text = share_path("config/fastdds.xml").read_text()
        place = free_place(shared_memory, int(os.environ.get("ROS_DOMAIN_ID") or 0), os.getpid())
        with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
            file.write(text.replace("<rtps>", f"<rtps>\n      <participantID>{place}</participantID>", 1))
            file.flush()
            with _set(PROFILE_VARIABLE, file.name):
                yield


def uses_fast_dds() -> bool:
    """Whether the middleware that ROS 2 has chosen here reads a profile of Fast DDS."""
    return rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps")


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


def free_place(shared_memory: Path, domain: int, first: int) -> int:
    """The first place from ``first`` on, around the circle, that nobody has or had; else the first that nobody has.

    Args:
        shared_memory: folder with Fast DDS's files.
        domain: ROS domain id.
        first: any number; processes that start together should have different ones.

    Returns:
        The place; ``first``'s own if all are taken.
    """
    base = _PORT_BASE + _PER_DOMAIN * domain + _USER_UNICAST
    places = [(first + step) % _PLACES for step in range(_PLACES)]
    ports = {place: f"fastrtps_port{base + _PER_PARTICIPANT * place}" for place in places}
    for place in places:
        if not any(shared_memory.glob(f"{ports[place]}*")):
            return place
    # Looking through the mappings of all processes takes a while.
    in_use = mapped(shared_memory)
    return next((place for place in places if ports[place] not in in_use), first % _PLACES)
