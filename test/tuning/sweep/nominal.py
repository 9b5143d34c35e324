"""A sweep without uncertainty."""

from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.stage.description import UncertaintyParameters

EXACT = UncertaintyParameters(
    mass=0.0, force=0.0, air_gap=0.0, friction=1.0, sensor_noise=0.0, shortest_delay=1.0, longest_delay=1.0, jitter=0.0,
    map_noise=0.0,
)  # fmt: skip
"""The machine that the controller was designed for."""


def within(uncertainty: UncertaintyParameters, values: dict[str, dict], delay: float = 0.5) -> dict[str, dict]:
    """``values`` by node, with the uncertainty, and commands ``delay`` samples late."""
    described = {f"uncertainty.{name}": value for name, value in to_mapping(uncertainty).items()}
    stage = {**values.get("stage", {}), **described, "drive.delay": delay}
    return {**values, "stage": stage}
