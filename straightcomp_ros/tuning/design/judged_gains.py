"""What gains are worth on a stage: one number for a search, from the linear demands and from simulated strokes.

    cost = accuracy + quiet · 2 ln(1 + work / scale) + penalties

accuracy is the mean of ln p-p over some starts of the stage as described, with a share of ln RMS, which moves less from
start to start, and a share of ln p-p on the extreme machines. work is the RMS step of the current from sample to
sample; its scale is the current that carries Coulomb friction, F_C / K̄_i, which the stage needs in any case.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.stage.description import Factors, StageParameters, deviating
from straightcomp_ros.tuning.design.gains import with_gains
from straightcomp_ros.tuning.design.prepared_stroke import PreparedStroke, RunFigures, prepared_stroke, shortened
from straightcomp_ros.tuning.design.stability import STANDARD, Demands, StabilityCheck

_STARTS = 3
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
_SILENT = 0.02
"""At rest, the RMS step of the current that is taken for silence, in units of the current that carries friction."""


class Judgement(NamedTuple):
    """Cost, and the stage's figures in m and A; infinite where gains were not simulated."""

    cost: float
    pp: float
    rms: float
    work: float
    rest_work: float


@dataclass(frozen=True, eq=False)
class Judge:
    """Judges gains of ``law`` on one stage.

    Attributes:
        control: of which the law and its gains are replaced.
        check: the linear demands.
        stroke, short: of the stage as described, and of the extreme machines.
        quiet: weight of the coils' work, 0 to 1.
    """

    control: ControlParameters
    law: str
    stage: StageParameters
    check: StabilityCheck
    stroke: PreparedStroke
    short: PreparedStroke
    extremes: list["Extreme"]
    quiet: float

    @property
    def work_scale(self) -> float:
        """Current in A that carries Coulomb friction."""
        return self.stage.friction.coulomb / self.stage.actuator.current_stiffness

    @property
    def delay(self) -> float:
        """Of a command, s."""
        return self.stage.drive.delay * self.stage.period

    def judge(self, gains: Mapping[str, float], bar: float = math.inf) -> Judgement:
        """Judge ``gains``, by dotted name; by their first stroke alone if it costs more than ``bar``."""
        infinite = (math.inf,) * 4
        try:
            control = with_gains(self.control, self.law, gains)
        except ParameterError:
            return Judgement(3.0 * _UNSTABLE, *infinite)
        violation = self.check.violation(control)
        if violation > 0.0:
            return Judgement(_UNSTABLE + min(_UNSTABLE, violation), *infinite)
        law = make_law(control, self.stage)
        nominal = [self.stroke.run(law, self.delay)]
        first = self._nominal(nominal)
        if first.cost > bar:
            return first
        nominal += [self.stroke.run(law, self.delay, start) for start in range(1, _STARTS)]
        found = self._nominal(nominal)
        if not math.isfinite(found.pp):
            return found
        return found._replace(cost=found.cost + self._extreme(law, _accuracy(found)))

    def _nominal(self, runs: list[RunFigures]) -> Judgement:
        """The judgement of ``runs`` of the stage as described."""
        pp, rms, work, rest = (_mean(runs, name) for name in ("pp", "rms", "work", "rest_work"))
        found = Judgement(_UNSTABLE, pp, rms, work, rest)
        if not math.isfinite(pp):
            return found
        cost = _accuracy(found) + self.quiet * _WORK_WEIGHT * math.log1p(work / self.work_scale)
        cost += self._penalty(runs)
        if self.law == "smc_observer" and rest > _SILENT * self.work_scale:
            cost += 0.1 + math.log(rest / (_SILENT * self.work_scale))
        return found._replace(cost=cost)

    def _extreme(self, law: Law, accuracy: float) -> float:
        """What the extreme machines add to the cost."""
        runs = [
            self.short.run(law, machine.delay * self.stage.period, plant=machine.plant) for machine in self.extremes
        ]
        if not all(math.isfinite(run.pp) for run in runs):
            return 0.5 * _UNSTABLE
        mean = float(np.mean([math.log(run.pp) for run in runs]))
        return _SHARE_EXTREME * (mean - accuracy) + self._penalty(runs)

    def _penalty(self, runs: list[RunFigures]) -> float:
        """For each oscillation by its size, for each platform that met its stop."""
        lines = sum(0.3 + math.log(run.oscillation) for run in runs if run.oscillation > 1.0)
        return lines + sum(run.excursion >= self.stroke.plant.platform.stop for run in runs)


def _accuracy(found: Judgement) -> float:
    return (1.0 - _SHARE_RMS) * math.log(found.pp) + _SHARE_RMS * math.log(_PP_PER_RMS * found.rms)


def _mean(runs: list[RunFigures], name: str) -> float:
    return float(np.mean([getattr(run, name) for run in runs]))


def judge_of(scenario: Scenario, law: str, quiet: float, demands: Demands = STANDARD) -> Judge:
    """The judge of gains of ``law`` on the stage of ``scenario``; ``quiet`` from 0 to 1."""
    return Judge(
        control=next(iter(scenario.controls.values())),
        law=law,
        stage=scenario.description,
        check=StabilityCheck(scenario.description, demands),
        stroke=prepared_stroke(scenario, shortened(scenario, _LONGEST)),
        short=prepared_stroke(scenario, shortened(scenario, _SHORT)),
        extremes=extreme_machines(scenario),
        quiet=quiet,
    )


class Extreme(NamedTuple):
    """A machine at an end of the uncertainty, on which a law must neither oscillate nor fail; its delay in samples."""

    plant: PlantParameters
    delay: float


def extreme_machines(scenario: Scenario) -> list[Extreme]:
    """The machines: each has the loop gain, the friction and the delay of one end of its range, or of its middle."""
    ranges, delay = scenario.description.uncertainty, scenario.description.drive.delay
    latest, soonest = delay * max(1.0, ranges.longest_delay), delay * min(1.0, ranges.shortest_delay)
    ends = (
        (1.0, -1.0, latest),
        (1.0, 1.0, latest),
        (-1.0, 1.0, delay),
        (-1.0, -1.0, soonest),
        (0.0, 1.0, latest),
        (0.0, -1.0, delay),
    )
    return [
        Extreme(
            deviating(
                scenario.driver.plant,
                Factors(
                    mass=1.0 - gain * ranges.mass,
                    force=1.0 + gain * ranges.force,
                    air_gap=1.0 - gain * ranges.air_gap,
                    friction=ranges.friction**friction,
                ),
            ),
            late,
        )
        for gain, friction, late in ends
    ]
