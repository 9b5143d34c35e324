"""A stage that is described roughly, and machines that it may be."""

from pathlib import Path

import numpy as np
from recorded_run import rewired
from surveys import one_run

from straightcomp_ros.model.plant import BIAS
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from straightcomp_ros.straightness.survey import Run, Survey, read_survey, write_survey
from straightcomp_ros.tuning.commissioning.machine import SimulatedMachine, Work
from straightcomp_ros.tuning.survey.survey_check import LEAST_POINTS, WIDEST_GAP

ROUGH = Path(__file__).with_name("rough.yaml")
MACHINES = {
    "as described": {},
    "strong, narrow and light, with little friction": {"force": 1.4, "air_gap": 0.6, "mass": 0.6, "friction": 0.34},
    "weak and wide, with much friction": {"force": 0.6, "air_gap": 1.4, "friction": 3.0},
    "slow amplifier, late commands": {"amplifier": 0.5, "stage.drive.delay": 1.4},
    "fast amplifier, soon commands": {"amplifier": 2.0, "stage.drive.delay": 0.6},
}
"""What differs in the machine: facts of the simulated truth, or parameters of the driver (dotted)."""


def values_of(machine={}, **stage):  # noqa: B006
    """Parameters by node and dotted name."""
    values = shipped_parameters(stage=str(ROUGH))
    values["stage"] |= {name.replace("__", "."): value for name, value in stage.items()}
    values["driver"] |= {name if "." in name else f"simulated.truth.{name}": one for name, one in machine.items()}
    return values


def work_on(values, folder, wiring=None):
    """What a first step works on."""
    description = node_parameters("controller", values).stage
    return Work(SimulatedMachine(values, wiring), values, description, folder, 40, 20, {})


def other_guide(file):
    """A survey of another guide of the same length and height."""
    x = np.linspace(0.0, 1.76, 177)
    write_survey(file, one_run(x, 1e-5 * np.sin(7.0 * x)))
    return str(file)


def check_of(guide, file):
    """A check survey of ``guide``, out and back at 15 places, as a straightedge would give it."""
    true, random = load_map(MapParameters(file=guide)), np.random.default_rng(1)
    x = np.linspace(true.span[0] + 0.02, true.span[1] - 0.02, 15)
    runs = tuple(
        Run("1", direction, x, true.deviations(x) + 4e-6 * x + 5e-8 * random.standard_normal(x.size))
        for direction in ("forward", "backward")
    )
    write_survey(file, Survey(runs))
    return read_survey(file, min_points=LEAST_POINTS, max_gap=WIDEST_GAP)


readback_backwards = rewired(lambda sample: sample._replace(current=-sample.current))
readback_of_half_the_scale = rewired(lambda sample: sample._replace(current=0.5 * sample.current))
readback_dead = rewired(lambda sample: sample._replace(current=0.0 * sample.current))
readback_with_an_offset = rewired(lambda sample: sample._replace(current=sample.current + 0.1))
encoder_backwards = rewired(lambda sample: sample._replace(y=-sample.y))
encoder_dead = rewired(lambda sample: sample._replace(y=0.0))
# Each count is twice as long as described, so that half of the way is read.
encoder_of_twice_the_count = rewired(lambda sample: sample._replace(y=round(0.5 * sample.y / 1e-7) * 1e-7))


def lossy_bus(hardware):
    random = np.random.default_rng(1)
    return rewired(lambda sample: None if random.random() < 0.01 else sample)(hardware)


def noisy_encoder(hardware):
    """Ten times the described noise of half a count."""
    random = np.random.default_rng(1)
    return rewired(lambda sample: sample._replace(y=sample.y + 1e-7 * round(random.normal(0.0, 5.0))))(hardware)


def one_coil_dead(hardware):
    """The coil of the far magnet carries no current.

    The other one's, I0 + i, is what (2) makes of half of it as bias and half of it as control current; and half of it
    is what the board measures as the difference of both coils.
    """
    half, enable, write = 0.5 * hardware._bias, hardware.enable, hardware.write

    def enabled():
        enable()
        hardware._plant.state[BIAS] = half
        write(half, 0)

    hardware.enable = enabled
    hardware.write = lambda current, at_ns, sample_ns=None: write(half + 0.5 * current, at_ns, sample_ns)
    return hardware
