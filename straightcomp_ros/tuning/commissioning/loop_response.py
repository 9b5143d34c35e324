"""Step `frequency_response`: plant and margins as measured; does what was identified explain them?

The same measurement is made of the simulated machine as identified. Between rest and sliding, friction is neither a
spring nor a damping: what it makes of the response depends on the excitation, and no closed form has it.
"""

import dataclasses

import numpy as np

from straightcomp_ros.control.excitation import FrequencyResponseError, MultisineParameters
from straightcomp_ros.tuning.commissioning.certificate import LEAST_GAIN, LEAST_PHASE
from straightcomp_ros.tuning.commissioning.outcome import Outcome, Work
from straightcomp_ros.tuning.commissioning.step_files import LOOP
from straightcomp_ros.tuning.frequency_response import ExcitationEnded
from straightcomp_ros.tuning.frequency_response.response_margins import ResponseMargins, response_margins
from straightcomp_ros.tuning.frequency_response.simulated_measurement import (
    WITHIN_DB,
    WITHIN_DEG,
    ComparedResponse,
    measure_simulated,
)

_FORESEEN = 0.7
"""Part of the travel that the excitation may need in the simulation."""
_MOTIONS = (1.0, 0.7, 0.5, 0.35)
"""Parts of the usual motion, tried in this order. With 0.7 times the motion a machine needed 0.4 times the travel."""
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
    from straightcomp_ros.tuning.frequency_response.response_plot import plot_response

    plot_response(found, work.folder / LOOP, f"Stage '{stage.name}' under law '{found.law}'")
    measured = found.measured
    lines = measured.coherent
    margins = response_margins(measured.frequencies[lines], measured.response.open_loop[lines])
    gain, phase = (np.abs(values[lines]) for values in found.deviations)
    figures = {
        "margins": margins.to_display(),
        "model_margins": response_margins(measured.frequencies[lines], found.model.open_loop[lines]).to_display(),
        "coherent_lines": int(lines.sum()),
        "lines": int(lines.size),
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
            f"{phase.max(initial=0.0):.2g}° off (allowed: {WITHIN_DB:g} dB, {WITHIN_DEG:g}°){_changed(found)}"
            f"{f'; {found.lateness}' if found.lateness else ''}",
            figures,
        )
    small = _too_small(margins)
    if small:
        return Outcome(False, small, figures)
    return Outcome(
        True,
        f"the model explains the plant within {gain.max(initial=0.0):.2f} dB and {phase.max(initial=0.0):.1f}°; "
        f"{_told(margins)}, peak of |S| {margins.peak:.2f}",
        figures,
    )


def _too_small(margins: ResponseMargins) -> str:
    """What the margins lack, in a sentence; empty if nothing.

    A gain margin beyond the lines is larger than any that is demanded. The gain crossover must be among them: every law
    that holds this unstable plant has one.
    """
    if margins.phase is None:
        return (
            "no gain crossover is among the coherent lines, so that the phase margin is unknown; look for noise on y, "
            "and for more friction than was identified"
        )
    low, high = margins.gain_low or 0.0, margins.gain_high or np.inf
    if margins.phase >= LEAST_PHASE and high >= LEAST_GAIN and low <= 1.0 / LEAST_GAIN:
        return ""
    return (
        f"the measured margins are too small: {_told(margins)} (allowed: phase >= {LEAST_PHASE:g}°, gain down to "
        f"{1.0 / LEAST_GAIN:.2g} and up to {LEAST_GAIN:g} times)"
    )


def _told(margins: ResponseMargins) -> str:
    low = "" if margins.gain_low is None else f" down to {margins.gain_low:.2f}"
    high = "" if margins.gain_high is None else f" up to {margins.gain_high:.2f}"
    both = f"{low} and{high}" if low and high else low or high
    gain = f"gain{both} times" if both else "gain beyond the lines"
    return f"phase margin {margins.phase:.0f}°, {gain}"


def _measured(work: Work) -> ComparedResponse:
    """The response; once more with half the motion if the platform left the travel, which late commands may cause."""
    excitation, described = _foreseen(work, MultisineParameters(travel=work.travel))
    try:
        found = work.machine.response(work.values, excitation)
    except ExcitationEnded:
        excitation, described = _foreseen(work, dataclasses.replace(excitation, motion=0.5 * excitation.motion))
        found = work.machine.response(work.values, excitation)
    return dataclasses.replace(found, model=described.measured.response)


def _foreseen(work: Work, excitation: MultisineParameters) -> tuple[MultisineParameters, ComparedResponse]:
    """The excitation, with less motion where the machine as identified needs too much of the travel; its response.

    No closed form tells the peaks: where the current reaches its limit, the magnets carry the platform on.
    """
    reason = ""
    for share in _MOTIONS:
        tried = dataclasses.replace(excitation, motion=share * excitation.motion)
        # The same currents within less travel.
        within = dataclasses.replace(tried, travel=_FORESEEN * tried.travel, motion=tried.motion / _FORESEEN)
        try:
            return tried, measure_simulated(work.described(), within)
        except ExcitationEnded as error:
            reason = str(error)
    raise FrequencyResponseError(f"the machine as identified needs too much of the travel: {reason}")


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
