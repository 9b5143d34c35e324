"""A sweep without uncertainty."""

from straightcomp_ros.offline.sweep.uncertainty import UncertaintyParameters

EXACT = UncertaintyParameters(
    mass=0.0, force=0.0, air_gap=0.0, friction=1.0, sensor_noise=0.0, shortest_delay=0.5, longest_delay=0.5, jitter=0.0,
    map_noise=0.0,
)  # fmt: skip
"""The machine that the controller was designed for, and half a sample's delay as in the simulation."""
