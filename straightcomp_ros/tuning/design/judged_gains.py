"""What gains are worth on a stage: one number for a search, from the linear demands and from simulated strokes.

    cost = accuracy + quiet · 2 ln(1 + work / scale) + penalties

accuracy is the mean of ln p-p over some starts of the stage as described, with a share of ln RMS, which moves less from
start to start, and a share of ln p-p on the extreme machines. work is the RMS step of the current from sample to
sample; its scale is the current that carries Coulomb friction, F_C / K̄_i, which the stage needs in any case, and at
least four steps of the D/A converter, which a count asks for on a stage without friction.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from straightcomp_ros.control.laws import make_law
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.stage.description import Factors, deviating
from straightcomp_ros.tuning.design.gains import with_gains
from straightcomp_ros.tuning.design.prepared_stroke import RunFigures, prepared_stroke, shortened
from straightcomp_ros.tuning.design.stability import STANDARD, Demands, StabilityCheck

_STARTS, _MORE_STARTS = 3, 9
"""Of the stage as described; more where the first ones leave errors that differ by more than ``UNEVEN``."""
UNEVEN = 1.5
"""Largest over smallest p-p: on the shipped stage nine starts differ by 1.14."""
_SHORT = 6.0
"""s; of the strokes on the extreme machines."""
_LONGEST = 20.0
"""s; of the strokes on the stage as described."""
_UNSTABLE = 10.0
"""Cost of gains that miss a linear demand: they are not simulated."""
_SHARE_RMS = 0.2
_SHARE_EXTREME = 0.15
_PP_PER_RMS = 6.0
_WORK_WEIGHT = 2.0
_LEAST_STEPS = 4.0
_SILENT = 0.02
"""At rest, the RMS step of the current that is taken for silence, in units of the current that carries friction."""


class Judgement(NamedTuple):
    """Cost, and the stage's p-p in m and work in A; infinite where gains were not simulated."""

    cost: float
    pp: float = math.inf
    work: float = math.inf


class Judge:
    """Judges gains of ``law`` on the stage of ``scenario``; ``quiet``, from 0 to 1, is the weight of the coils' work.

    ``control`` is the controller's, of which the law and its gains are replaced, ``delay`` that of a command in s.
    """

    def __init__(self, scenario: Scenario, law: str, quiet: float, demands: Demands = STANDARD) -> None:
        self.law, self.stage, self._quiet = law, scenario.description, quiet
        self.control = next(iter(scenario.controls.values()))
        self.delay = self.stage.drive.delay * self.stage.period
        self._check = StabilityCheck(self.stage, demands)
        self._stroke = prepared_stroke(scenario, shortened(scenario, _LONGEST))
        self._short = prepared_stroke(scenario, shortened(scenario, _SHORT))
        self._extremes = extreme_machines(scenario)
        carried = self.stage.friction.coulomb / self.stage.actuator.current_stiffness
        self._work_scale = max(carried, _LEAST_STEPS * self.stage.drive.current_step)

    def judge(self, gains: Mapping[str, float], bar: float = math.inf) -> Judgement:
        """Judge ``gains``, by dotted name; by their first stroke alone if it costs more than ``bar``."""
        try:
            control = with_gains(self.control, self.law, gains)
        except ParameterError:
            return Judgement(3.0 * _UNSTABLE)
        violation = self._check.violation(control)
        if violation > 0.0:
            return Judgement(_UNSTABLE + min(_UNSTABLE, violation))
        law, runs = make_law(control, self.stage), []
        for start in range(_STARTS):
            runs.append(self._stroke.run(law, self.delay, start))
            if start == 0 and (first := self._nominal(runs)[0]).cost > bar:
                return first
        if max(run.pp for run in runs) > UNEVEN * min(run.pp for run in runs):
            runs += [self._stroke.run(law, self.delay, start) for start in range(_STARTS, _MORE_STARTS)]
        found, accuracy = self._nominal(runs)
        if not math.isfinite(found.pp):
            return found
        extremes = [self._short.run(law, delay, plant=plant) for plant, delay in self._extremes]
        if not all(math.isfinite(run.pp) for run in extremes):
            return found._replace(cost=found.cost + 0.5 * _UNSTABLE)
        mean = float(np.mean([math.log(run.pp) for run in extremes]))
        return found._replace(cost=found.cost + (_SHARE_EXTREME * (mean - accuracy) + self._penalty(extremes)))

    def _nominal(self, runs: list[RunFigures]) -> tuple[Judgement, float]:
        """The judgement of ``runs`` of the stage as described, and their accuracy."""
        pp, rms, work, rest = (
            float(np.mean([getattr(run, name) for run in runs])) for name in ("pp", "rms", "work", "rest_work")
        )
        if not math.isfinite(pp):
            return Judgement(_UNSTABLE, pp, work), math.inf
        accuracy = (1.0 - _SHARE_RMS) * math.log(pp) + _SHARE_RMS * math.log(_PP_PER_RMS * rms)
        cost = accuracy + self._quiet * _WORK_WEIGHT * math.log1p(work / self._work_scale) + self._penalty(runs)
        if self.law == "smc_observer" and rest > _SILENT * self._work_scale:
            cost += 0.1 + math.log(rest / (_SILENT * self._work_scale))
        return Judgement(cost, pp, work), accuracy

    def _penalty(self, runs: list[RunFigures]) -> float:
        """For each oscillation by its size, for each platform that met its stop."""
        lines = sum(0.3 + math.log(run.oscillation) for run in runs if run.oscillation > 1.0)
        return lines + sum(run.excursion >= self._stroke.plant.platform.stop for run in runs)


def extreme_machines(scenario: Scenario) -> list[tuple[PlantParameters, float]]:
    """Machines on which a law must neither oscillate nor fail, and the delay of their commands in s: each has the loop
    gain, the friction and the delay of one end of its range, or of its middle."""
    stage, ranges = scenario.description, scenario.description.uncertainty
    latest, soonest = max(1.0, ranges.longest_delay), min(1.0, ranges.shortest_delay)
    ends = (
        (1.0, -1.0, latest),
        (1.0, 1.0, latest),
        (-1.0, 1.0, 1.0),
        (-1.0, -1.0, soonest),
        (0.0, 1.0, latest),
        (0.0, -1.0, 1.0),
    )
    return [
        (
            deviating(
                scenario.driver.plant,
                Factors(
                    mass=1.0 - gain * ranges.mass,
                    force=1.0 + gain * ranges.force,
                    air_gap=1.0 - gain * ranges.air_gap,
                    friction=ranges.friction**friction,
                ),
            ),
            stage.drive.delay * late * stage.period,
        )
        for gain, friction, late in ends
    ]
