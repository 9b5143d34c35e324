"""What a design must hold in the linear loop, by how much gains miss it, and how far a stage may differ until it fails.

The law is linearised as in `control/margins.py` and closed over plants that are sampled once for a stage: the nominal
one with more and less gain and with later commands, and one for each corner of the uncertainty of mass, force and air
gap. There no current is measured, which a board may lack and which changes nothing while amplifier and delay are as
described. With it, the amplifier's gain may be off by a factor, which is the gain margin that a frequency response of
the machine shows, and commands may act as soon as the uncertainty says: without it, a law at 1 kHz that endures a fifth
of its delay leaves more than twice the error. Friction is left out: in truth it helps. Growth and decay are compared in
units of the loop's dead time T_d, so that the same numbers hold for every stage.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from straightcomp_ros.control.laws import ControlParameters, make_law, states_of
from straightcomp_ros.control.margins import (
    MECHANICS,
    NotLinear,
    StateSpace,
    closed_loop,
    last_stable,
    linearised,
    loop_margins,
    phase_margin,
    sampled_plant,
    spectral_radius,
    with_facts_off,
    with_modes_off,
)
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.design.gains import scaled_facts

_GRID = 400
"""Frequencies at which the phase margin is looked for: off by less than a degree, near a resonance two."""
_NOT_LINEAR = 100.0
"""Miss of a law that cannot be linearised: more than any that can."""
_LIGHTEST, _HEAVIEST = 0.05, 20.0


@dataclass(frozen=True)
class Demands:
    """What is demanded of the loop."""

    gain_low: float = 0.62  # factors of the loop gain at which the law must be stable
    gain_high: float = 2.1
    stiff_gain_low: float = 0.7  # the same where the law is at its stiffest
    stiff_gain_high: float = 1.9
    amplifier_gain: float = 1.5
    """Factor, up and down, of the current that the amplifier makes of a command and the law measures; its square root
    where the law is at its stiffest."""
    phase: float = 10.0  # least phase margin, degrees
    spare_delay: float = 0.25
    """Of a command beyond the longest one of the uncertainty, samples; a third of it at its stiffest."""
    decay: float = 0.03  # least decay of the nominal loop without modes, in 1/T_d

    def tightened(self, by: float) -> "Demands":
        """The demands with gain ranges wider by the factor ``by``, and ``by`` times the phase and the spare delay."""
        narrow = {name: getattr(self, name) / by for name in ("gain_low", "stiff_gain_low")}
        wide = ("gain_high", "stiff_gain_high", "amplifier_gain", "phase", "spare_delay")
        return dataclasses.replace(self, **narrow, **{name: getattr(self, name) * by for name in wide})


STANDARD = Demands()
"""The demands of a design, unless others are asked for."""


class _Case(NamedTuple):
    """One loop that must be stable: which, its plant, the gain, the least decay in 1/T_d, and whether the law measures
    the current."""

    name: str
    plant: StateSpace
    gain: float = 1.0
    decay: float = 0.0
    with_current: bool = False


class StabilityCheck:
    """The loops of one stage that must be stable."""

    def __init__(self, stage: StageParameters, demands: Demands = STANDARD) -> None:
        self._stage, self._phase = stage, demands.phase
        latest = stage.drive.delay * max(1.0, stage.uncertainty.longest_delay)
        earliest = stage.drive.delay * min(1.0, stage.uncertainty.shortest_delay)
        self._nominal = plain = sampled_plant(stage)

        rung = {name: sampled_plant(machine) for name, machine in with_modes_off(stage).items()}

        def cases(low: float, high: float, amplifier: float, spare: float, where: str = "") -> tuple[_Case, ...]:
            less = 1.0 / amplifier
            return (
                _Case(f"least gain{where}", plain, low),
                _Case(f"most gain{where}", plain, high),
                _Case(f"amplifier's gain × {less:.2g}{where}", plain, less, with_current=True),
                _Case(f"amplifier's gain × {amplifier:.2g}{where}", plain, amplifier, with_current=True),
                _Case(f"late commands{where}", sampled_plant(stage, (latest + spare) * stage.period)),
                _Case(f"early commands{where}", sampled_plant(stage, earliest * stage.period), with_current=True),
                *(_Case(f"modes at {name}{where}", plant) for name, plant in rung.items()),
            )

        # A mode that the loop leaves alone decays as it does by itself: it must be stable, and no more.
        self._quiet = (
            _Case("nominal", sampled_plant(stage.with_modes()), decay=demands.decay),
            *cases(demands.gain_low, demands.gain_high, demands.amplifier_gain, demands.spare_delay),
            *(_Case(f"corner {one.name}", one.sampled) for one in corners_of(stage, MECHANICS)),
        )
        root, spare = math.sqrt(demands.amplifier_gain), demands.spare_delay / 3.0
        self._stiff = cases(demands.stiff_gain_low, demands.stiff_gain_high, root, spare, ", stiffest")

    def violation(self, control: ControlParameters) -> float:
        """By how much the gains miss the demands, 0 if they hold them all; a smooth measure for a search."""
        misses = [miss for _, miss in self._misses(control)]
        return sum(misses) + max(misses)

    def missed(self, control: ControlParameters) -> list[str]:
        """Names of the demands that the gains miss, the worst first."""
        misses = sorted(((miss, name) for name, miss in self._misses(control) if miss > 0.0), reverse=True)
        return [name for _, name in misses]

    def _misses(self, control: ControlParameters) -> list[tuple[str, float]]:
        misses: list[tuple[str, float]] = []
        for state, one in states_of(control, self._stage).items():
            law = make_law(one, self._stage)
            try:
                laws = tuple(linearised(law, with_current=measured) for measured in (False, True))
            except NotLinear:
                # The current limit is nearer than any step of the differences.
                misses.append(("linear at rest", _NOT_LINEAR))
                continue
            cases = self._stiff if state == "stiff" else self._quiet
            misses += [(case.name, self._missing(case, laws[case.with_current])) for case in cases]
            for linear, how in zip(laws, ("", ", current measured"), strict=True):
                phase = phase_margin(self._nominal, linear, self._stage.period, _GRID)
                misses.append((f"phase{how}", max(0.0, self._phase - phase) / 60.0))
        return misses

    def _missing(self, case: _Case, law: StateSpace) -> float:
        radius = spectral_radius(closed_loop(case.plant, law, case.gain))
        return max(0.0, math.log(radius) * self._stage.dead_time / self._stage.period + case.decay)


class Corner(NamedTuple):
    """A machine at a corner of the uncertainty: in words, as a description of its own, and sampled, with and without
    its modes."""

    name: str
    stage: StageParameters
    sampled: StateSpace
    rigid: StateSpace


def corner_at(name: str, stage: StageParameters) -> Corner:
    """A machine that is as ``stage`` describes it."""
    sampled = sampled_plant(stage)
    rigid = sampled_plant(stage.with_modes()) if stage.platform.modes.present else sampled
    return Corner(name, stage, sampled, rigid)


def corners_of(stage: StageParameters, facts: Sequence[str] = (*MECHANICS, "amplifier", "delay")) -> list[Corner]:
    """The machines at all corners of what ``stage`` leaves open of ``facts``; ParameterError if one is impossible."""
    return [corner_at(name, machine) for name, machine in with_facts_off(stage, facts).items()]


class FailingLimits(NamedTuple):
    """Between what the loop is stable."""

    gain_low: float  # factors of the loop gain
    gain_high: float
    amplifier_low: float  # factors of the amplifier's gain, with the current measured behind it
    amplifier_high: float
    phase: float  # smallest phase margin, with and without the measured current, degrees
    longest_delay: float  # of a command, samples
    mass_low: float  # factors of the mass
    mass_high: float


def failing_limits(stage: StageParameters, control: ControlParameters) -> dict[str, FailingLimits]:
    """The limits of a law by its state: ``quiet``, for a law that stiffens ``stiff``, and where the stage may have no
    friction ``slow`` and ``free``."""
    return {state: _limits(stage, one) for state, one in states_of(control, stage).items()}


def _limits(stage: StageParameters, control: ControlParameters) -> FailingLimits:
    law = make_law(control, stage)
    margins, measured = loop_margins(law, stage), loop_margins(law, stage, with_current=True)
    controller = linearised(law)

    def stable(factor: float) -> bool:
        plant = sampled_plant(scaled_facts(stage, ("platform.mass",), factor))
        return spectral_radius(closed_loop(plant, controller)) < 1.0

    low, high = (last_stable(stable, 1.0, end) if stable(1.0) else 1.0 for end in (_LIGHTEST, _HEAVIEST))
    return FailingLimits(
        gain_low=margins.gain_low,
        gain_high=margins.gain_high,
        amplifier_low=measured.gain_low,
        amplifier_high=measured.gain_high,
        phase=min(margins.phase, measured.phase),
        longest_delay=margins.longest_delay / stage.period,
        mass_low=low,
        mass_high=high,
    )
