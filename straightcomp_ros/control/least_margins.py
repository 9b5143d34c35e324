"""The least margins with which the controller uses a law on a stage, and the sentence that refuses less.

They are less than a design demands (`stability_demands.py`): below them a small difference between the machine and its
description makes the loop unstable. Each limit costs one set of eigenvalues, because gains may change while the loop
runs; how far the loop is stable is looked for only where a limit is missed.
"""

from collections.abc import Callable, Iterator

from straightcomp_ros.control.laws import OPEN_LOOP, ControlParameters, make_law, stiffened
from straightcomp_ros.control.margins import (
    StateSpace,
    closed_loop,
    linearised,
    phase_margin,
    sampled_plant,
    spectral_radius,
)
from straightcomp_ros.stage.description import StageParameters

LEAST_GAINS = (0.8, 1.25)
"""Factors of the loop gain between which the law must be stable: 2 dB to each side."""
_STIFFEST_GAINS = (0.9, 1.1)
"""The same where the law is at its stiffest, which it leaves again when it has learned the friction."""
LEAST_PHASE = 5.0
"""Degrees."""
_MEASURED = ", with the coils' current measured,"
_FREQUENCIES = 400
_HALVINGS = 10


def missing_margin(control: ControlParameters, stage: StageParameters) -> str | None:
    """What the law of ``control`` lacks on ``stage``: a sentence with parameters, value, limit and remedy.

    None if it has the least margins, if it has no linearisation at rest and so no linear margins, or if it is none.
    """
    if control.law == OPEN_LOOP:
        return None
    try:
        missed = next(_missed(control, stage), None)
    except ValueError:
        return None
    if missed is None:
        return None
    group = "smc_observer" if control.law == "smc_observer" else "smc"
    return (
        f"parameters 'control.{group}.*': on stage '{stage.name}' at {stage.rate} Hz with commands "
        f"{stage.drive.delay:g} samples late, the law '{control.law}' {missed}; "
        "straightcomp design finds gains for a stage"
    )


def _missed(control: ControlParameters, stage: StageParameters) -> Iterator[str]:
    """Each limit that the law misses, in words; ValueError if the law has no linearisation at rest."""
    loop = _Loop(control, stage)
    yield from _gains_missed(loop, "", LEAST_GAINS)
    yield from _gains_missed(_Loop(control, stage, with_current=True), _MEASURED, LEAST_GAINS)
    stiff = stiffened(control)
    if stiff is not control:
        yield from _gains_missed(_Loop(stiff, stage), ", at its stiffest,", _STIFFEST_GAINS)
        yield from _gains_missed(
            _Loop(stiff, stage, with_current=True), f", at its stiffest{_MEASURED}", _STIFFEST_GAINS
        )
    latest = stage.drive.delay * max(1.0, stage.uncertainty.longest_delay)
    if not loop.stable_at_delay(latest):
        longest = _border(loop.stable_at_delay, stage.drive.delay, latest)
        yield (
            f"is stable with commands up to {longest:.2f} samples late; allowed: >= {latest:g}, "
            "stage.drive.delay × stage.uncertainty.longest_delay"
        )
    phase = phase_margin(loop.plant, loop.law, stage.period, _FREQUENCIES)
    if phase < LEAST_PHASE:
        yield f"has a phase margin of {phase:.1f}°; allowed: >= {LEAST_PHASE:g}°"


def _gains_missed(loop: "_Loop", where: str, gains: tuple[float, float]) -> Iterator[str]:
    low, high = gains
    if not loop.stable_at_gain(1.0):
        yield f"is{where} unstable; allowed: stable from {low:g} to {high:g} times its loop gain"
        return
    for limit, direction, allowed in ((low, "down", "<="), (high, "up", ">=")):
        if not loop.stable_at_gain(limit):
            border = _border(loop.stable_at_gain, 1.0, limit)
            yield f"is{where} stable {direction} to {border:.2f} times its loop gain; allowed: {allowed} {limit:g}"


class _Loop:
    """A law, linearised, around the plant of a stage; with or without the measured current."""

    def __init__(self, control: ControlParameters, stage: StageParameters, *, with_current: bool = False) -> None:
        self.law = linearised(make_law(control, stage), with_current=with_current)
        self.plant = sampled_plant(stage, stage.drive.delay * stage.period)
        self._stage = stage

    def stable_at_gain(self, factor: float) -> bool:
        return self._stable(self.plant, factor)

    def stable_at_delay(self, samples: float) -> bool:
        return self._stable(sampled_plant(self._stage, samples * self._stage.period), 1.0)

    def _stable(self, plant: StateSpace, gain: float) -> bool:
        return spectral_radius(closed_loop(plant, self.law, gain)) < 1.0


def _border(stable: Callable[[float], bool], inside: float, outside: float) -> float:
    """Where the loop becomes unstable between ``inside``, which is stable, and ``outside``, which is not."""
    for _ in range(_HALVINGS):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if stable(middle) else (inside, middle)
    return inside
