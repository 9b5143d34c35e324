"""The known ROS 2 middlewares: our profile for each, and what differs under it."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from straightcomp_ros.parameters.share import share_path

RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


class Middleware(NamedTuple):
    """What differs between middlewares; an unknown one gets no profile, and its reception times are not used.

    Attributes:
        variable: environment variable that names a profile; if the user has set it, ours is not used.
        loopback: our profile for nodes on this computer only; empty for none.
        network: our profile for any other discovery range; empty for none.
        uri: prefix of a profile's path in the variable.
        loopback_range: discovery range required with ``loopback``.
        stamps_arrival: the reception time is a message's time of arrival, not of its take.
    """

    variable: str = ""
    loopback: str = ""
    network: str = ""
    uri: str = ""
    loopback_range: str = "LOCALHOST"
    stamps_arrival: bool = False


_FAST_DDS = Middleware(
    # Jazzy's Fast DDS does not know the name that replaces it in version 3.
    variable="FASTRTPS_DEFAULT_PROFILES_FILE",
    loopback="config/fastdds_loopback.xml",
    network="config/fastdds.xml",
    # With LOCALHOST rmw_fastrtps adds shared memory, whatever the profile says.
    loopback_range="SYSTEM_DEFAULT",
    stamps_arrival=True,
)
_CYCLONE_DDS = Middleware(variable="CYCLONEDDS_URI", loopback="config/cyclonedds_loopback.xml", uri="file://")
MIDDLEWARES = {
    "rmw_fastrtps_cpp": _FAST_DDS,
    "rmw_fastrtps_dynamic_cpp": _FAST_DDS,
    "rmw_cyclonedds_cpp": _CYCLONE_DDS,
}


def middleware(identifier: str) -> Middleware:
    """The middleware of this name."""
    return MIDDLEWARES.get(identifier, Middleware())


def profile_variables(identifier: str, environment: Mapping[str, str]) -> dict[str, str]:
    """Environment variables that give a participant our profile; empty if the user has set one, or we have none."""
    chosen = middleware(identifier)
    on_loopback = environment.get(RANGE_VARIABLE) == "LOCALHOST"
    profile = chosen.loopback if on_loopback else chosen.network
    if not profile or chosen.variable in environment:
        return {}
    variables = {chosen.variable: f"{chosen.uri}{share_path(profile)}"}
    return {**variables, RANGE_VARIABLE: chosen.loopback_range} if on_loopback else variables


def missing_profile(identifier: str, environment: Mapping[str, str]) -> str:
    """The variable in which the user names a profile of Fast DDS that is not there, with its value; else empty.

    Fast DDS then starts with its defaults, which use shared memory.
    """
    chosen = middleware(identifier)
    file = environment.get(chosen.variable)
    # Cyclone DDS's variable may hold the profile itself, or several files.
    return f"{chosen.variable}={file}" if file is not None and not chosen.uri and not Path(file).is_file() else ""


def description(identifier: str, environment: Mapping[str, str]) -> str:
    """One line for a log: the middleware's name, its profile, and what differs from Fast DDS."""
    chosen, ours = middleware(identifier), profile_variables(identifier, environment)
    profile = chosen.variable if chosen.variable in environment else next(iter(ours.values()), "its own default")
    if missing := missing_profile(identifier, environment):
        profile = f"its own default, since there is no file {missing}"
    unknown = "; it does not say when a message arrived: latencies end when it was sent"
    differs = "" if chosen.stamps_arrival else unknown
    return f"{identifier}, profile: {profile}{differs}"
