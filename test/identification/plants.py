"""Plants that differ from the one at which the search starts, and a short run."""

SHORT = {"motion.stroke": 0.5, "motion.settle": 0.2, "motion.pause": 0.1}
STIFF = {
    "platform.mass": 3.4,
    "friction.coulomb": 0.3,
    "friction.static": 0.5,
    "friction.stribeck_velocity": 30e-6,
    "friction.bristle_stiffness": 1.5e6,
    "friction.viscous": 25.0,
}
SOFT = {
    "platform.mass": 4.2,
    "actuator.air_gap": 1.6e-3,
    "friction.coulomb": 0.9,
    "friction.static": 1.1,
    "friction.stribeck_velocity": 100e-6,
    "friction.bristle_stiffness": 4e5,
    "friction.bristle_damping": 600.0,
    "friction.viscous": 40.0,
}
FAR = {
    "platform.mass": 3.3,
    "actuator.turns": 361.0,
    "actuator.air_gap": 9.5e-4,
    "friction.coulomb": 0.15,
    "friction.static": 0.225,
    "friction.viscous": 3.5,
    "drive.bandwidth": 770.0,
    "drive.delay": 1.33,
}
"""So far from the description that a search from there ends in a wrong valley."""
SAFE = {"control.smc.natural_frequency": 14.0, "control.smc.phi": 13.8}
"""Gains of law 'linear' that are stable on FAR as on the description."""
