"""A made-up map whose reference excites what a stroke along the real guide leaves in the dark.

It is a survey file for `stage.guide.file`: the platform then follows its waves while the stage moves, in simulation
and on a real machine alike. Long waves reach far to both sides (stiffness) and slide steadily (Coulomb friction), short
ones are quick (mass, viscous friction); every turn of every wave reverses the motion (bristles), and while the stage
speeds up and slows down all of it happens slowly (Stribeck).
"""

import math

import numpy as np

from straightcomp_ros.straightness.survey import Run, Survey

WAVES = ((0.300, 30e-6), (0.060, 15e-6), (0.030, 8e-6), (0.015, 4e-6))
"""Wavelength and amplitude in m: at 0.3 m/s 1, 5, 10 and 20 Hz, together up to 57 µm and 1.3 mm/s."""
_SPACING = 1e-3
_PHASE = 1.0


def excitation_survey(length: float, first: float = 0.0) -> Survey:
    """The map over ``length`` in m, from x = ``first``."""
    x = np.linspace(0.0, length, round(length / _SPACING) + 1)
    deviation = sum(
        amplitude * np.sin(2.0 * math.pi * x / wavelength + number * _PHASE)
        for number, (wavelength, amplitude) in enumerate(WAVES)
    )
    return Survey((Run("1", "forward", first + x, np.asarray(deviation)),), "excitation")
