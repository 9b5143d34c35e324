"""What a design must hold in the linear loop, and by how much gains miss it.

The law is linearised as in `control/margins.py` and closed over plants that are sampled once for a stage: the nominal
one with more and less gain and with later commands, and one for each corner of the uncertainty of mass, force and air
gap. Friction is left out: in truth it helps. Growth and decay are compared in units of the loop's dead time T_d, so
that the same numbers hold for every stage.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.margins import StateSpace, closed_loop, linearised, phase_margin, sampled_plant
from straightcomp_ros.design.searched_gains import stiffened
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.stage.truth import Factors, deviating

_GRID = 400
"""Frequencies at which the phase margin is looked for: off by less than a degree."""
_NOT_LINEAR = 100.0
"""Miss of a law that cannot be linearised: more than any that can."""


@dataclass(frozen=True)
class Demands:
    """What is demanded of the loop.

    Attributes:
        gain_low, gain_high: factors of the loop gain at which the law must be stable.
        stiff_gain_low, stiff_gain_high: the same where the law is at its stiffest.
        phase: least phase margin, degrees.
        spare_delay: of a command beyond the longest one of the uncertainty, samples; a third of it at its stiffest.
        decay: least decay of the nominal loop, in 1/T_d.
    """

    gain_low: float = 0.62
    gain_high: float = 2.1
    stiff_gain_low: float = 0.7
    stiff_gain_high: float = 1.9
    phase: float = 10.0
    spare_delay: float = 0.25
    decay: float = 0.03

    def tightened(self, by: float) -> "Demands":
        """The demands with gain ranges wider by the factor ``by``, and ``by`` times the phase and the spare delay."""
        return dataclasses.replace(
            self,
            gain_low=self.gain_low / by,
            gain_high=self.gain_high * by,
            stiff_gain_low=self.stiff_gain_low / by,
            stiff_gain_high=self.stiff_gain_high * by,
            phase=self.phase * by,
            spare_delay=self.spare_delay * by,
        )


STANDARD = Demands()
"""The demands of a design, unless others are asked for."""


class _Case(NamedTuple):
    """One loop that must be stable: which, its plant, the gain, and the least decay in 1/T_d."""

    name: str
    plant: StateSpace
    gain: float
    decay: float


class StabilityCheck:
    """The loops of one stage that must be stable.

    Args:
        stage: its description.
        demands: what is asked for.
    """

    def __init__(self, stage: StageParameters, demands: Demands = STANDARD) -> None:
        self._stage = nominal = stage
        self._phase = demands.phase
        self._delay = nominal.drive.delay
        latest = self._delay * max(1.0, nominal.uncertainty.longest_delay)
        plain = self._sampled(nominal, self._delay)
        self._nominal = plain
        corners = [
            _Case(f"corner {name}", self._sampled(corner, self._delay), 1.0, 0.0) for name, corner in _corners(nominal)
        ]
        self._quiet = (
            _Case("nominal", plain, 1.0, demands.decay),
            _Case("least gain", plain, demands.gain_low, 0.0),
            _Case("most gain", plain, demands.gain_high, 0.0),
            _Case("late commands", self._sampled(nominal, latest + demands.spare_delay), 1.0, 0.0),
            *corners,
        )
        self._stiff = (
            _Case("least gain, stiffest", plain, demands.stiff_gain_low, 0.0),
            _Case("most gain, stiffest", plain, demands.stiff_gain_high, 0.0),
            _Case("late commands, stiffest", self._sampled(nominal, latest + demands.spare_delay / 3.0), 1.0, 0.0),
        )

    @staticmethod
    def _sampled(stage: StageParameters, delay: float) -> StateSpace:
        return sampled_plant(stage, delay * stage.period)

    def violation(self, control: ControlParameters) -> float:
        """By how much the gains miss the demands, 0 if they hold them all; a smooth measure for a search."""
        misses = [miss for _, miss in self._misses(control)]
        return sum(misses) + max(misses)

    def missed(self, control: ControlParameters) -> list[str]:
        """Names of the demands that the gains miss, the worst first."""
        misses = [(miss, name) for name, miss in self._misses(control) if miss > 0.0]
        return [name for _, name in sorted(misses, reverse=True)]

    def _misses(self, control: ControlParameters) -> list[tuple[str, float]]:
        stiff = stiffened(control)
        ends = [(control, self._quiet)]
        if stiff is not control:
            ends.append((stiff, self._stiff))
        misses = []
        for one, cases in ends:
            try:
                law = linearised(make_law(one, self._stage))
            except ValueError:
                # The current limit is nearer than any step of the differences.
                misses.append(("linear at rest", _NOT_LINEAR))
                continue
            misses += [(case.name, self._missing(case, law)) for case in cases]
            phase = phase_margin(self._nominal, law, self._stage.period, _GRID)
            misses.append(("phase", max(0.0, self._phase - phase) / 60.0))
        return misses

    def _missing(self, case: _Case, law: StateSpace) -> float:
        radius = float(np.abs(np.linalg.eigvals(closed_loop(case.plant, law, case.gain))).max())
        return max(0.0, math.log(radius) * self._stage.dead_time / self._stage.period + case.decay)


def _corners(stage: StageParameters) -> Sequence[tuple[str, StageParameters]]:
    """The stages at the corners of the uncertainty of mass, force and air gap, each with its name."""
    ranges = stage.uncertainty
    found = []
    for signs in itertools.product((-1, 1), repeat=3):
        mass, force, gap = (
            1.0 + sign * width for sign, width in zip(signs, (ranges.mass, ranges.force, ranges.air_gap), strict=True)
        )
        plant = deviating(stage.plant, Factors(mass, force, gap))
        corner = dataclasses.replace(stage, platform=plant.platform, actuator=plant.actuator)
        found.append((f"mass × {mass:g}, force × {force:g}, gap × {gap:g}", corner))
    return found
