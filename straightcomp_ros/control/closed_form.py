"""Frequency responses in closed form: the sampled plant of a description under a law's own linearisation.

Friction has no frequency response. While the platform slides to and fro with a velocity that is much like Gaussian
noise, it acts on the small parts of the motion as a damping, its statistical linearisation E[v F(v)] / E[v²]
(A. Gelb and W. Vander Velde, Multiple-Input Describing Functions, 1968, chapter 7). That damping falls with velocity:
responses are comparable only between motions of the same velocity. At rest the bristles would instead act as a spring
of σ0, for motions that are far smaller than F_C/σ0, which is usually less than a count or two of the encoder.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.law import Law
from straightcomp_ros.control.margins import StateSpace, linearised, open_loop, response, sampled_plant
from straightcomp_ros.model.lugre import LuGreParameters
from straightcomp_ros.stage.description import StageParameters

Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class LoopResponse:
    """Responses at some frequencies, (lines,) each.

    Attributes:
        plant: from command to reading, m/A.
        open_loop: from command to what the law answers to it, with its sign turned: −1 is the critical point.
        sensitivity: from a disturbance of the command to the command.
    """

    plant: Complex
    open_loop: Complex
    sensitivity: Complex


def friction_damping(friction: LuGreParameters, speed: float) -> float:
    """Damping in N·s/m that friction equals, at an RMS velocity ``speed`` > 0 in m/s that is Gaussian."""
    stribeck = friction.stribeck_velocity**2 / (friction.stribeck_velocity**2 + 2.0 * speed**2)
    sliding = friction.coulomb + (friction.static - friction.coulomb) * stribeck
    return friction.viscous + math.sqrt(2.0 / math.pi) * sliding / speed


def plant_response(stage: StageParameters, frequencies: NDArray[np.float64], damping: float) -> Complex:
    """The plant of ``stage`` with ``damping`` in N·s/m, at ``frequencies`` (lines,) in Hz."""
    return _position(_plant(stage, damping), _points(stage, frequencies))


def loop_response(
    law: Law, stage: StageParameters, frequencies: NDArray[np.float64], damping: float = 0.0
) -> LoopResponse:
    """Plant and loop of ``law`` on ``stage``.

    The law also answers to the measured current, on which command and plant act as on the position.

    Args:
        law: the law; its own friction model is left out.
        stage: the machine.
        frequencies: (lines,) Hz.
        damping: of the platform's motion, N·s/m.

    Raises:
        ValueError: the law has no linearisation at rest.
    """
    z, plant = _points(stage, frequencies), _plant(stage, damping)
    loop = open_loop(plant, linearised(law, with_current=True), z)
    return LoopResponse(_position(plant, z), loop, 1.0 / (1.0 + loop))


def _position(plant: StateSpace, z: Complex) -> Complex:
    return response(plant, z)[:, 0, 0]


def _plant(stage: StageParameters, damping: float) -> StateSpace:
    return sampled_plant(stage, stage.drive.delay * stage.period, damping)


def _points(stage: StageParameters, frequencies: NDArray[np.float64]) -> Complex:
    return np.asarray(np.exp(2j * math.pi * frequencies * stage.period))
