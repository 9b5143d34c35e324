"""What is injected into the loop: the same tables of currents live and offline, from the same parameters."""

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.closed_form import LoopResponse, loop_response
from straightcomp_ros.control.excitation_parameters import ExcitationParameters, MultisineParameters
from straightcomp_ros.control.injection import Injection
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.multisine import Multisine, multisine
from straightcomp_ros.stage.description import StageParameters

_FADE = 0.25
"""s over which a multisine rises and falls."""


def loop_multisine(parameters: MultisineParameters, law: Law, stage: StageParameters) -> Multisine:
    """The multisine shaped for ``law`` on ``stage`` as described; raises as `multisine`, and ValueError for a law
    without a linearisation at rest."""

    def expected(frequencies: NDArray[np.float64]) -> LoopResponse:
        return loop_response(law, stage, frequencies, stage.friction.viscous)

    return multisine(parameters, stage.rate, expected)


def simple_currents(parameters: ExcitationParameters, stage: StageParameters) -> NDArray[np.float64]:
    """(n,) A, of a shake or a ramp."""
    count = max(2, round(parameters.duration * stage.rate))
    if parameters.signal == "shake":
        # No slow part is left that could move the platform.
        steps = parameters.current * np.random.default_rng(parameters.seed).uniform(-1.0, 1.0, count // 2)
        return np.stack([steps, -steps], axis=1).ravel()
    end = parameters.current if parameters.signal == "ramp_up" else -parameters.current
    return np.linspace(0.0, end, count)


def made_injection(parameters: ExcitationParameters, law: Law, stage: StageParameters) -> Injection:
    """The injection; raises as :func:`loop_multisine`."""
    if parameters.signal == "multisine":
        return multisine_injection(parameters, loop_multisine(parameters, law, stage), stage)
    currents = simple_currents(parameters, stage)
    return Injection(currents, fade=1, limit=stage.highest_current, travel=parameters.travel)


def multisine_injection(parameters: MultisineParameters, excitation: Multisine, stage: StageParameters) -> Injection:
    """The injection of a multisine, with its fades."""
    fade = max(1, round(_FADE * stage.rate))
    return Injection(excitation.currents, fade=fade, limit=stage.highest_current, travel=parameters.travel)
