"""The poles that the paper prints for its design."""

import numpy as np

from straightcomp_ros.control.sliding_mode import closed_loop_poles
from straightcomp_ros.tuning.paper.claims import Claim
from straightcomp_ros.tuning.paper.ideal_machine import Machine

PAPER = (-175.9, 131.9, -100.0)
"""Real and imaginary part of the pair, and the real pole, rad/s."""


def claims(machine: Machine) -> tuple[Claim, ...]:
    """Poles of the nominal plant under (9) without its switching term."""
    poles = closed_loop_poles(machine.control.smc, machine.stage)
    pair = poles[np.argmax(poles.imag)]
    single = poles[np.argmin(np.abs(poles.imag))]
    names = ("closed-loop pole pair, real part", "closed-loop pole pair, imaginary part", "third closed-loop pole")
    ours = (pair.real, pair.imag, single.real)
    note = "eigenvalues of A − B K; K from the design, M and the magnets cancel"
    return tuple(
        Claim(name, paper, float(value), "rad/s", tolerance=0.1, note=note)
        for name, paper, value in zip(names, PAPER, ours, strict=True)
    )
