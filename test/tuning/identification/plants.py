"""Plants that differ from the one at which the search starts, and a short run."""

from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import by_node

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


def values(plant, law="linear", **stage):
    """Parameters for a short run on a machine with this plant, of which the law knows nothing."""
    return {
        "driver": {f"stage.{name}": value for name, value in plant.items()},
        "feedforward": {},
        "controller": {"control.law": law},
        "cell": {},
        "stage": {"drive.delay": 0.5, **SHORT, **{name.replace("_", "."): value for name, value in stage.items()}},
    }


def record(
    bag,
    parameters,
    wiring=lambda hardware: hardware,
):
    """Simulate, and write the bag; ``wiring`` puts something between the machine and its driver."""
    simulation = Simulation(parameters, wiring=wiring)
    with SimulatedRun(bag, by_node(parameters), simulation.delay) as run:
        simulation.run(observe=run.add)
    return bag
