"""Step `frequency_response`: plant and margins as measured; does what was identified explain them?

The same measurement is made of the simulated machine as identified. Between rest and sliding, friction is neither a
spring nor a damping: what it makes of the response depends on the excitation, and no closed form has it.
"""

import dataclasses

import numpy as np

from straightcomp_ros.commissioning.certificate import LEAST_GAIN, LEAST_PHASE
from straightcomp_ros.commissioning.outcome import Outcome, Work
from straightcomp_ros.commissioning.step_files import LOOP
from straightcomp_ros.frequency_response import ExcitationEnded, FrequencyResponseError
from straightcomp_ros.frequency_response.excitation_parameters import MultisineParameters
from straightcomp_ros.frequency_response.response_margins import response_margins
from straightcomp_ros.frequency_response.simulated_measurement import (
    WITHIN_DB,
    WITHIN_DEG,
    ComparedResponse,
    measure_simulated,
)

_ALIKE_DB = 0.5
"""Deviations are alike if half of them are within this of their median."""


def frequency_response(work: Work) -> Outcome:
    """Measure under the designed law, with the stage at rest."""
    stage = work.stage
    try:
        found = _measured(work)
    except FrequencyResponseError as error:
        return Outcome(False, str(error))
    # Only here: matplotlib takes longer to import than the measurement.
    from straightcomp_ros.frequency_response.response_plot import plot_response

    plot_response(found, work.folder / LOOP, f"Stage '{stage.name}' under law '{found.law}'")
    measured = found.measured
    margins = response_margins(measured.frequencies, measured.response.open_loop)
    gain, phase = (np.abs(values[measured.coherent]) for values in found.deviations)
    figures = {
        "margins": margins.to_display(),
        "model_margins": response_margins(measured.frequencies, found.model.open_loop).to_display(),
        "coherent_lines": int(measured.coherent.sum()),
        "lines": int(measured.coherent.size),
        "largest_deviation_dB": float(gain.max(initial=0.0)),
        "largest_deviation_deg": float(phase.max(initial=0.0)),
        "frequency_Hz": measured.frequencies.tolist(),
        "coherence": measured.coherence.tolist(),
        "plant_um_A": (np.abs(measured.response.plant) * 1e6).tolist(),
        "model_plant_um_A": (np.abs(found.model.plant) * 1e6).tolist(),
    }
    if not found.explained:
        return Outcome(
            False,
            f"what was identified does not explain the measured plant: up to {gain.max(initial=0.0):.2g} dB and "
            f"{phase.max(initial=0.0):.2g}° off (allowed: {WITHIN_DB:g} dB, {WITHIN_DEG:g}°){_changed(found)}",
            figures,
        )
    if (margins.phase or 180.0) < LEAST_PHASE or (margins.gain_high or 10.0) < LEAST_GAIN:
        sentence = f"the measured margins are too small: phase {margins.phase:.0f}°, gain {margins.gain_high:.2g}"
        return Outcome(False, sentence, figures)
    return Outcome(
        True,
        f"the model explains the plant within {gain.max(initial=0.0):.2f} dB and {phase.max(initial=0.0):.1f}°; "
        f"phase margin {margins.phase:.0f}°, peak of |S| {margins.peak:.2f}"
        if margins.phase is not None
        else f"the model explains the plant; peak of |S| {margins.peak:.2f}",
        figures,
    )


def _measured(work: Work) -> ComparedResponse:
    """The response; once more with half the motion if the platform left the travel: how far it moves is a guess."""
    excitation = MultisineParameters(travel=work.travel)
    try:
        found = work.machine.response(work.values, excitation)
    except ExcitationEnded:
        excitation = dataclasses.replace(excitation, motion=0.5 * excitation.motion)
        found = work.machine.response(work.values, excitation)
    try:
        described = measure_simulated(work.described(), excitation)
    except ExcitationEnded as error:
        raise FrequencyResponseError(
            f"the machine as identified would leave the travel, this one did not: {error}"
        ) from error
    return dataclasses.replace(found, model=described.measured.response)


def _changed(found: ComparedResponse) -> str:
    """What one factor of force over mass would explain; empty if none does.

    From the higher half of the coherent lines: there, neither friction nor the magnets' stiffness tells.
    """
    gain, _ = found.deviations
    high = gain[found.measured.coherent]
    high = high[high.size // 2 :]
    middle = float(np.median(high)) if high.size else 0.0
    if abs(middle) <= WITHIN_DB or float(np.median(np.abs(high - middle))) > _ALIKE_DB:
        return ""
    return (
        f": a current accelerates the platform {10.0 ** (middle / 20.0):.2g} times as much as when it was identified; "
        "look whether the platform is loose, or has lost a part of its load, and at the coils"
    )
