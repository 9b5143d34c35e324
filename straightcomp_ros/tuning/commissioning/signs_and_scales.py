"""Step `signs_and_scales`: the signs of current and force, the readback, amplifier and delay, before a loop is closed.

First a quick random current, which the platform's mass averages out: the readback answers, the platform does not.
Then a slow ramp either way, until friction gives way. The amplifier goes off as soon as the platform has moved some
micrometres, so that nothing has to be known of the magnets' negative stiffness.
"""

import math
from typing import Any

import numpy as np

from straightcomp_ros.control.excitation import ExcitationParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.commissioning.current_readback import CurrentReadback, current_readback
from straightcomp_ros.tuning.commissioning.outcome import Outcome, Work

_SHAKE = 0.005
"""Random current, relative to the bias current."""
_SHAKE_TIME = 0.25
_ENOUGH = 40
"""Samples of it from which the readback can be told."""
_ONE_COIL = 0.3
"""Part of a single coil's pull from which a coil is missing."""
_RAMP_TIME = 2.0
_RAMP_SHARE = 0.5
"""Highest current of a ramp, relative to the highest current."""
_TRAVEL, _TRAVEL_COUNTS = 3e-6, 6.0
"""m and counts of the encoder, whichever is more: the platform leaves faster the farther it is, and has to coast."""
_PULLED = 0.3
"""Part of the first breakaway current below which it was not the current that moved the platform."""
_GAIN_WITHIN = 0.05
_SILENT = 0.05
"""Gain of a readback that does not answer."""
_OFFSET = 0.03
"""Largest offset of a readback, relative to the bias current."""
_BEYOND = 1.1
"""Factor beyond its range at which a fact is called wrong."""


def signs_and_scales(work: Work) -> Outcome:
    """Shake, then push either way."""
    stage = work.stage
    current = _SHAKE * stage.actuator.bias_current
    shake = ExcitationParameters(signal="shake", current=current, duration=_SHAKE_TIME, travel=_travel(stage))
    shaken = work.machine.play(shake)
    if shaken.left_at is not None and (pulled := _unbalanced(shaken.left_at, stage)):
        return Outcome(False, pulled)
    readback = current_readback(shaken, stage.drive, stage.period)
    figures: dict[str, Any] = {
        "readback_gain": readback.gain,
        "readback_offset_A": readback.offset,
        "amplifier_bandwidth_Hz": readback.bandwidth,
        "delay_samples": readback.delay,
    }
    wrong = _readback_fault(readback, stage)
    if wrong:
        return Outcome(False, wrong, figures)
    currents, moved, farthest = [], [], 0.0
    for signal in ("ramp_up", "ramp_down"):
        ramp = ExcitationParameters(signal=signal, current=_highest(stage), duration=_RAMP_TIME, travel=_travel(stage))
        pushed = work.machine.play(ramp)
        # The answer to the sample itself may be zero already.
        currents.append(math.nan if pushed.left_at is None else float(pushed.command[max(0, pushed.left_at - 1)]))
        moved.append(float(pushed.y[-1] - pushed.y[0]))
        farthest = max(farthest, float(np.abs(pushed.y - pushed.y[0]).max()))
    figures |= {"breakaway_currents_A": currents, "farthest_um": farthest * 1e6}
    wrong = _force_fault(currents, moved, stage)
    if wrong:
        return Outcome(False, wrong, figures)
    pushed_back = moved[1] < 0.0
    sentence = (
        f"readback {readback.gain:.4g} times the command, amplifier {readback.bandwidth:.0f} Hz, delay "
        f"{readback.delay:.2f} samples; friction gives way at {1e3 * currents[0]:.3g}"
        f"{f' and {1e3 * currents[1]:.3g} mA' if pushed_back else ' mA, and the magnets pull the platform on'}; "
        f"the platform moved at most {farthest * 1e6:.0f} µm"
    )
    found = {"drive.bandwidth": readback.bandwidth, "drive.delay": readback.delay}
    return Outcome(True, sentence, figures, stage=found)


def _travel(stage: StageParameters) -> float:
    return max(_TRAVEL, _TRAVEL_COUNTS * stage.encoder.y_resolution)


def _unbalanced(left_at: int, stage: StageParameters) -> str:
    """What pulled the platform away without a current that could; empty where the samples are enough all the same.

    At rest only friction holds the platform against the magnets' negative stiffness: it may slowly creep away.
    """
    actuator, time = stage.actuator, max(1, left_at) / stage.rate
    acceleration = 2.0 * _travel(stage) / time**2
    # One coil alone, with the bias current, at the heaviest and weakest machine that is described.
    ranges = stage.uncertainty
    weakest = (1.0 - ranges.force) / ((1.0 + ranges.air_gap) ** 2 * (1.0 + ranges.mass))
    alone = 0.25 * weakest * actuator.current_stiffness * actuator.bias_current / stage.platform.mass
    if acceleration < _ONE_COIL * alone and left_at >= _ENOUGH:
        return ""
    return (
        f"with the amplifier on and hardly any current the platform left {_travel(stage) * 1e6:g} µm within "
        f"{time * 1e3:.3g} ms: the magnets do not balance; look for a coil without current, and for a bias current "
        f"that is not {actuator.bias_current:g} A in both"
    )


def _highest(stage: StageParameters) -> float:
    """Highest current of a ramp, A."""
    return _RAMP_SHARE * stage.highest_current


def _readback_fault(found: CurrentReadback, stage: StageParameters) -> str:
    ranges, drive = stage.uncertainty, stage.drive
    if abs(found.gain) < _SILENT:
        return (
            f"the measured current does not answer: it stays at {found.gain:.2g} times the commanded one; look at the "
            "readback, and whether the amplifier has its supply"
        )
    if found.gain < 0.0:
        return "the measured current runs against the command: the readback is wired backwards"
    if math.isnan(found.bandwidth) or found.unexplained > 0.5:
        return "the measured current does not follow the command like a first-order amplifier; look at the readback"
    if abs(found.gain - 1.0) > _GAIN_WITHIN:
        return (
            f"the readback shows {found.gain:.3g} times the commanded current; allowed: 1 ± {_GAIN_WITHIN:g}; look at "
            "the readback's scale and 'stage.drive.gain'"
        )
    if abs(found.offset) > _OFFSET * stage.actuator.bias_current:
        return (
            f"the readback shows {found.offset * 1e3:.3g} mA without a command; allowed: "
            f"±{_OFFSET * stage.actuator.bias_current * 1e3:.3g} mA; look at the zero of the readback, and at the bias "
            "currents of both coils"
        )
    factor = found.bandwidth / drive.bandwidth
    if not 1.0 / (_BEYOND * ranges.amplifier) <= factor <= _BEYOND * ranges.amplifier:
        return (
            f"the amplifier has {found.bandwidth:.0f} Hz, {factor:.2g} times what is described; allowed by "
            f"'stage.uncertainty.amplifier': within a factor of {ranges.amplifier:g}; look at its tuning and its supply"
        )
    # One that is shorter than described makes no law less stable, and what was found replaces the description.
    latest = ranges.longest_delay * drive.delay
    if found.delay > latest * _BEYOND:
        return (
            f"commands act {found.delay:.2f} samples after theirs; allowed by 'stage.drive.delay' and "
            f"'stage.uncertainty.longest_delay': up to {latest:.2g}"
        )
    return ""


def _force_fault(currents: list[float], moved: list[float], stage: StageParameters) -> str:
    expected = stage.friction.static / stage.actuator.current_stiffness
    if all(map(math.isnan, currents)):
        return (
            f"{_highest(stage):.2g} A do not move the platform; friction should give way at {expected:.2g} A; look for "
            "a blocked platform, a coil without current, or an encoder of y that does not count"
        )
    first, second = map(abs, currents)
    if moved[0] > 0.0 and moved[1] > 0.0 and second < _PULLED * first:
        # Where the first push left it, the magnets pull harder than friction holds: the second tells nothing.
        return ""
    if moved[0] < 0.0 or moved[1] > 0.0:
        return (
            "a positive current moves the platform toward negative y: the coils or the encoder of y are wired backwards"
        )
    if any(map(math.isnan, currents)):
        side = "positive" if math.isnan(currents[0]) else "negative"
        return f"the platform moves one way only, not with {side} current: one coil carries no current"
    return ""
