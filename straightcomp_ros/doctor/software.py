"""Python, this package's own files, ROS 2 and its middleware."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence

from straightcomp_ros.doctor.finding import Finding
from straightcomp_ros.parameters.middlewares import MIDDLEWARES, RANGE_VARIABLE, description
from straightcomp_ros.parameters.share import share_path

_OLDEST, _NEWEST = (3, 10), (3, 13)
_DISTRIBUTION = "jazzy"
_LAST_FREE_DOMAIN = 101
_ASK_ROS = """
import json, sys
import rclpy.utilities
import lifecycle_msgs.srv, sensor_msgs.msg, trajectory_msgs.msg, diagnostic_msgs.msg, std_srvs.srv
json.dump({"rclpy": rclpy.__file__, "rmw": rclpy.utilities.get_rmw_implementation_identifier()}, sys.stdout)
"""


def python(version: tuple[int, int] | None = None) -> Finding:
    """Whether this Python is one that the package runs on."""
    major, minor = version or (sys.version_info.major, sys.version_info.minor)
    detail = f"Python {major}.{minor}"
    if _OLDEST <= (major, minor) <= _NEWEST:
        return Finding("python", "ok", detail)
    return Finding("python", "fail", detail, "Use Python 3.10 to 3.13, e.g. make PYTHON=python3.12.")


def package_files() -> Finding:
    """Whether the parameter file and the synthetic survey are found."""
    try:
        folder = share_path("config/straightcomp.yaml").parent
        share_path("config/survey_synthetic.csv")
    except FileNotFoundError as error:
        return Finding("package files", "fail", str(error), "Install the package again: make setup, or colcon build.")
    return Finding("package files", "ok", str(folder))


def ros(command: Sequence[str] = (sys.executable, "-c", _ASK_ROS), timeout: float = 60.0) -> list[Finding]:
    """rclpy, the message packages and the middleware, asked in a process of their own: a broken one may crash it."""
    remedy = f"Source /opt/ros/{_DISTRIBUTION}/setup.bash, or install ROS 2's wheels with make setup."
    if "RMW_IMPLEMENTATION" in os.environ:
        remedy += f" RMW_IMPLEMENTATION asks for {os.environ['RMW_IMPLEMENTATION']}: install it, or unset the variable."
    try:
        asked = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return [Finding("rclpy", "fail", f"cannot be asked: {error}", remedy)]
    if asked.returncode != 0:
        last = (asked.stderr.strip().splitlines() or [f"ended with exit code {asked.returncode}"])[-1]
        return [Finding("rclpy", "fail", last, remedy)]
    answer = json.loads(asked.stdout)
    rmw = Finding("middleware", "ok", description(answer["rmw"], os.environ))
    if answer["rmw"] not in MIDDLEWARES:
        remedy = "Set RMW_IMPLEMENTATION to rmw_fastrtps_cpp or rmw_cyclonedds_cpp: no other one has been tried."
        rmw = Finding("middleware", "warn", rmw.detail, remedy)
    return [Finding("rclpy", "ok", answer["rclpy"]), rmw]


def distribution(environment: Mapping[str, str] = os.environ) -> Finding:
    """Which ROS 2 is sourced, if any."""
    name = environment.get("ROS_DISTRO")
    if name in (None, _DISTRIBUTION):
        return Finding("distribution", "ok", name or "none sourced: the wheels of the virtual environment are used")
    return Finding(
        "distribution", "warn", f"{name} is sourced", f"Source /opt/ros/{_DISTRIBUTION}/setup.bash in a new shell."
    )


def discovery(environment: Mapping[str, str] = os.environ) -> Finding:
    """Whether the graph keeps to this machine, and whether its domain's ports are free."""
    reach = environment.get(RANGE_VARIABLE, "SUBNET (ROS 2's default)")
    domain = environment.get("ROS_DOMAIN_ID", "0")
    detail = f"discovery range {reach}, domain {domain}"
    if not domain.isdigit() or int(domain) > _LAST_FREE_DOMAIN:
        return Finding(
            "discovery",
            "warn",
            detail,
            f"Set ROS_DOMAIN_ID to 0 to {_LAST_FREE_DOMAIN}: the ports of others are given out by Linux itself.",
        )
    if reach not in ("LOCALHOST", "OFF"):
        return Finding(
            "discovery",
            "warn",
            detail,
            f"Set {RANGE_VARIABLE}=LOCALHOST unless other machines shall take part in the graph.",
        )
    return Finding("discovery", "ok", detail)
