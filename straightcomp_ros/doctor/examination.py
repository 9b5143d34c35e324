"""All checks, one after the other."""

from collections.abc import Callable, Iterator
from pathlib import Path

from straightcomp_ros.doctor import can_bus, capacity, scheduling, software
from straightcomp_ros.doctor.finding import Finding

Checks = tuple[tuple[str, Callable[[], Finding | list[Finding]]], ...]
CHECKS: Checks = (
    ("python", software.python),
    ("package files", software.package_files),
    ("rclpy", software.ros),
    ("distribution", software.distribution),
    ("discovery", software.discovery),
    ("memlock", capacity.locked_memory),
    ("real-time priority", scheduling.priority),
    ("real-time throttling", scheduling.throttling),
    ("CPU wake-up", scheduling.wake_up_latency),
    ("kernel", scheduling.kernel),
    ("kernel preemption", scheduling.preemption),
    ("cores", scheduling.cores),
    ("frequency governor", scheduling.governor),
    ("clock", scheduling.clock),
    ("timer", scheduling.timer),
    ("CAN interfaces", can_bus.kernel_interfaces),
    ("python-can", can_bus.python_can),
    ("disk", lambda: capacity.disk(Path.cwd())),
)


def examine(checks: Checks = CHECKS) -> Iterator[Finding]:
    """Run the checks; one that the system does not permit is a warning, and the others still run."""
    for name, check in checks:
        try:
            found = check()
        except (OSError, AttributeError, ValueError) as error:
            found = Finding(name, "warn", f"cannot be looked at: {error}", "Look at it by hand.")
        yield from found if isinstance(found, list) else [found]
