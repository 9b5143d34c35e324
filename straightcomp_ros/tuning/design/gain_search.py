"""Search for gains: what they are worth on a stage, one number from the linear demands and from simulated strokes, and
CMA-ES, in logarithms, with the same result for the same seed on one machine.

    cost = accuracy + quiet · 2 ln(1 + work / scale) + penalties

accuracy is ln of the mean p-p over some starts of the stage as described, with a share of ln of the mean RMS, which
moves less from start to start, and a share of the mean of ln p-p on the extreme machines. work is the RMS step of the
current from sample to sample; its scale is the current that the stage needs in any case, which carries Coulomb
friction, F_C / K̄_i, or without friction the platform along the map, and at least four steps of the D/A converter, for
which a count asks.

What of a stroke does not depend on the gains is computed once; then each run takes a tenth of a second.

CMA-ES (Hansen and Ostermeier, Evolutionary Computation 9(2), 2001; the package `cma`) ranks candidates only, so that
neither the noise of a peak-to-peak nor the step to infeasible gains disturbs it. The cost of simulated strokes has
several valleys: a fast observer with a slow surface may be worth as much as the reverse. One search begins at each of
the best starts; the worse searches are given up on the way.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from straightcomp_ros.analysis.error_detail import sustained_oscillation, tolerated_amplitude
from straightcomp_ros.analysis.metrics import RESTING
from straightcomp_ros.analysis.record import motion_of
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import can_hold, make_law
from straightcomp_ros.model.motion import Trajectory, forward_and_back, reach
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.scenario import Scenario, Stroke
from straightcomp_ros.offline.starts import COUNTS_APART, offset
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.stage.description import deviating
from straightcomp_ros.straightness.feedforward import along
from straightcomp_ros.straightness.guide_map import map_of
from straightcomp_ros.straightness.residual import peak_to_peak, rms
from straightcomp_ros.straightness.survey import Survey
from straightcomp_ros.tuning.design.gains import SEARCHED, SHAPES, Values, with_gains
from straightcomp_ros.tuning.design.stability import STANDARD, Demands, StabilityCheck

_STARTS, _MORE_STARTS = 3, 9
"""Of the stage as described; more where the first ones leave errors that differ by more than ``UNEVEN``."""
UNEVEN = 1.5
"""Largest over smallest p-p: on the shipped stage nine starts differ by 1.14."""
SHORT = 6.0
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
"""Of the converter, and the current that carries friction, or without it the platform along the map: the units of work
from which a noisier command costs more than it may gain."""
_SILENT = 0.02
"""At rest, the RMS step of the current that is taken for silence, in units of the current that carries friction."""


class RunFigures(NamedTuple):
    """One run; all are infinite if it broke off."""

    pp: float  # true compensation error over the motion, m
    rms: float
    work: float  # RMS step of the commanded current from sample to sample over the motion, A
    rest_work: float  # the same between the strokes
    oscillation: float  # amplitude of the strongest held line in the error, relative to what a verdict tolerates
    excursion: float  # largest |y|, m


@dataclass(frozen=True, eq=False)
class PreparedStroke:
    """One motion of the stage of a scenario, ready to run under any law."""

    scenario: Scenario
    stroke: Stroke
    target: NDArray[np.float64]  # (n,) r at the true x, m
    motion: slice  # samples of the motion
    rest: slice  # samples between the strokes, empty without

    def run(self, law: Law, delay: float, start: int = 0, plant: PlantParameters | None = None) -> RunFigures:
        """Run the motion once under ``law``, on the scenario's own machine or on ``plant``.

        Each command is ``delay`` s late; ``start`` counts as in :func:`~straightcomp_ros.offline.starts.offset`.
        """
        late, count = np.full(self.target.size, round(delay * 1e9)), self.scenario.driver.plant.encoder.y_resolution
        # The stage's own count, so that an ideal encoder gets the same starts.
        cycle = self.scenario.cycle(law, self.stroke, late, plant=plant, offset=offset(start, COUNTS_APART * count))
        if cycle.current.size < late.size:
            return RunFigures(*(math.inf,) * 6)
        target, stamps = self.target[self.motion], self.stroke.stamps
        error = target - cycle.true_y[self.motion]
        period = float(stamps[-1] - stamps[0]) * 1e-9 / (stamps.size - 1)
        amplitude = sustained_oscillation(error, target, period).amplitude
        return RunFigures(
            pp=peak_to_peak(error),
            rms=rms(error),
            work=rms(np.diff(cycle.current[self.motion])),
            rest_work=rms(np.diff(cycle.current[self.rest])),
            oscillation=amplitude / tolerated_amplitude(error, count, peak_to_peak(target)),
            excursion=float(np.abs(cycle.true_y).max()),
        )


def prepared_stroke(
    scenario: Scenario,
    stamps: NDArray[np.int64] | None = None,
    ideal: bool = False,
    survey: Survey | None = None,
) -> PreparedStroke:
    """The motion of ``scenario``.

    Args:
        stamps: (n,) of the samples in ns from 0, if they are not on the grid.
        ideal: the law is given r, ṙ and r̈ of the true motion at each sample, without the encoder of x, the filter and
            the lead.
        survey: of the map that the law is given, in place of the scenario's, by which it is judged.
    """
    stroke = scenario.stroke(stamps)
    r, slope, curvature = along(stroke.map, stroke.true_x)
    time, x = np.asarray(stroke.stamps * 1e-9, dtype=np.float64), stroke.x
    if ideal:
        x = stroke.true_x
        speed = np.gradient(x, time)
        given = np.column_stack([r, slope * speed, curvature * speed * speed + slope * np.gradient(speed, time)])
        stroke = stroke._replace(given=given)
    if survey is not None:
        stroke = stroke._replace(given=scenario.stroke(stamps, survey).given)
    motion = motion_of(time, x)
    rest = slice(0, 0)
    if len(motion.strokes) > 1:
        begin = motion.strokes[0].stop + math.ceil(RESTING * 1e9 / scenario.description.period_ns)
        rest = slice(begin, max(begin, motion.strokes[1].start))
    return PreparedStroke(scenario, stroke, r, motion.window, rest)


def shortened(scenario: Scenario, duration: float) -> Scenario:
    """The scenario with a motion of at most about ``duration`` s, if its own is longer: over the steepest part of the
    map, with the stage's speed if it fits."""
    full = scenario.description.motion
    settle, pause = min(full.settle, 0.3), min(max(full.pause, 0.0), 0.5)
    moving = 0.5 * (duration - 2.0 * settle - pause)
    ramp = full.speed / full.acceleration
    length = full.speed * (moving - ramp) if moving > 2.0 * ramp else full.acceleration * (0.5 * moving) ** 2
    low, high = reach(full)
    if length >= high - low or scenario.trajectory.end_ns * 1e-9 <= duration:
        return scenario
    straightness = map_of(scenario.survey, scenario.description.guide)
    x = np.linspace(low, high, 2000)
    slope, curvature = straightness.evaluate(x)[1:]
    # Reversals of r make friction turn over, slopes make it large: where there is most of both.
    wanted = np.abs(slope) / np.abs(slope).max() + np.abs(curvature) / np.abs(curvature).max()
    count = max(1, round(length / (high - low) * x.size))
    start = float(x[int(np.convolve(wanted, np.ones(count), mode="valid").argmax())])
    part = dataclasses.replace(full, start=start, stroke=length, steps=1, file="", settle=settle, pause=pause)
    return dataclasses.replace(scenario, trajectory=Trajectory(forward_and_back(part)))


class Judged(NamedTuple):
    """Gains by dotted name, their cost, and the stage's p-p in m and work in A; infinite where they were not
    simulated."""

    gains: Mapping[str, float]
    cost: float
    pp: float = math.inf
    work: float = math.inf


class Judge:
    """Judges gains of ``law`` on the stage of ``scenario``; ``quiet``, from 0 to 1, is the weight of the coils' work.

    ``control`` is the controller's, of which the law and its gains are replaced.
    """

    def __init__(self, scenario: Scenario, law: str, quiet: float, demands: Demands = STANDARD) -> None:
        self.law, self.stage, self._quiet = law, scenario.description, quiet
        self.control = next(iter(scenario.controls.values()))
        self._stop = scenario.driver.plant.platform.stop
        self._check = StabilityCheck(self.stage, demands)
        self._stroke = prepared_stroke(shortened(scenario, _LONGEST))
        self._short = prepared_stroke(shortened(scenario, SHORT))
        self._extremes = extreme_machines(scenario)
        held, pull = can_hold(self.stage), abs(self.stage.negative_stiffness)
        carried = self.stage.friction.coulomb if held else pull * float(np.abs(self._stroke.target).max())
        scale = carried / self.stage.actuator.current_stiffness
        self._work_scale = max(scale, _LEAST_STEPS * self.stage.drive.current_step)
        self._silent = _SILENT * self._work_scale if held and law == "smc_observer" else math.inf

    def judge(self, gains: Mapping[str, float], bar: float = math.inf) -> Judged:
        """Judge ``gains``, by dotted name; by their first stroke alone if it costs more than ``bar``."""
        try:
            control = with_gains(self.control, self.law, gains)
        except ParameterError:
            return Judged(gains, 3.0 * _UNSTABLE)
        violation = self._check.violation(control)
        if violation > 0.0:
            return Judged(gains, _UNSTABLE + min(_UNSTABLE, violation))
        law, runs = make_law(control, self.stage), []
        for start in range(_STARTS):
            runs.append(self._stroke.run(law, self.stage.delay, start))
            if start == 0 and (first := self._nominal(gains, runs)[0]).cost > bar:
                return first
        if max(run.pp for run in runs) > UNEVEN * min(run.pp for run in runs):
            runs += [self._stroke.run(law, self.stage.delay, start) for start in range(_STARTS, _MORE_STARTS)]
        found, accuracy = self._nominal(gains, runs)
        if not math.isfinite(found.pp):
            return found
        extremes = [self._short.run(law, delay, plant=plant) for plant, delay in self._extremes]
        if not all(math.isfinite(run.pp) for run in extremes):
            return found._replace(cost=found.cost + 0.5 * _UNSTABLE)
        mean = float(np.mean([math.log(run.pp) for run in extremes]))
        return found._replace(cost=found.cost + (_SHARE_EXTREME * (mean - accuracy) + self._penalty(extremes)))

    def _nominal(self, gains: Mapping[str, float], runs: list[RunFigures]) -> tuple[Judged, float]:
        """``gains`` by their ``runs`` on the stage as described, and the accuracy of these."""
        pp, rms, work, rest = (
            float(np.mean([getattr(run, name) for run in runs])) for name in ("pp", "rms", "work", "rest_work")
        )
        if not math.isfinite(pp):
            return Judged(gains, _UNSTABLE, pp, work), math.inf
        accuracy = (1.0 - _SHARE_RMS) * math.log(pp) + _SHARE_RMS * math.log(_PP_PER_RMS * rms)
        cost = accuracy + self._quiet * _WORK_WEIGHT * math.log1p(work / self._work_scale) + self._penalty(runs)
        if rest > self._silent:
            cost += 0.1 + math.log(rest / self._silent)
        return Judged(gains, cost, pp, work), accuracy

    def _penalty(self, runs: list[RunFigures]) -> float:
        """For each oscillation by its size, for each platform that met its stop."""
        lines = sum(0.3 + math.log(run.oscillation) for run in runs if run.oscillation > 1.0)
        return lines + sum(run.excursion >= self._stop for run in runs)


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
            deviating(scenario.driver.plant, ranges.factors(-gain, gain, -gain, friction)),
            stage.drive.delay * late * stage.period,
        )
        for gain, friction, late in ends
    ]


_STEP = 0.3
"""Standard deviation of the first candidates' logarithms: a third of the gain."""
_POPULATION = 10
_VALLEYS = ((0.4, 4), (0.7, 2), (1.0, 1))
"""Until each fraction of the evaluations: searches that go on."""
_FEWEST = 60
"""Evaluations for each search: with fewer in all, fewer begin."""
_HOPELESS = 0.7
"""Cost of a first stroke beyond the best candidate's cost from which gains are judged by this stroke alone: twice the
error, which no luck in the other strokes makes up for."""


class Valley:
    """One run of CMA-ES over the searched gains of ``law``, from those of ``begin``.

    ``step`` is the standard deviation of the first candidates' logarithms. With ``rule`` the gains stay within their
    ranges relative to it, and those that are not searched are as in it; without, they are as in ``begin``.
    """

    def __init__(self, law: str, begin: Values, step: float, seed: int, rule: Values | None = None) -> None:
        from cma import CMAEvolutionStrategy

        self._rest = begin if rule is None else rule
        searched = [gain for gain in (*SEARCHED[law], *SHAPES) if gain.name in self._rest]
        self._names = [gain.name for gain in searched]
        first = [math.log(begin[name]) for name in self._names]
        options: dict[str, Any] = {"seed": seed, "popsize": _POPULATION, "verbose": -9}
        if any(gain.step != 1.0 for gain in searched):
            options["CMA_stds"] = [gain.step for gain in searched]
        if rule is not None:
            scales = [rule[gain.name] if gain.power else 1.0 for gain in searched]
            low = [math.log(gain.low * scale) for gain, scale in zip(searched, scales, strict=True)]
            high = [math.log(gain.high * scale) for gain, scale in zip(searched, scales, strict=True)]
            first = np.clip(first, low, high).tolist()
            options["bounds"] = [low, high]
        self._strategy = CMAEvolutionStrategy(first, step, options)
        self._asked: list[Sequence[float]] = []
        self.best = math.inf

    @property
    def exhausted(self) -> bool:
        """Whether further candidates would be the same."""
        return bool(self._strategy.stop())

    def ask(self) -> list[dict[str, float]]:
        """The next candidates."""
        self._asked = self._strategy.ask()
        return [{**self._rest, **dict(zip(self._names, map(math.exp, one), strict=True))} for one in self._asked]

    def tell(self, costs: Sequence[float]) -> None:
        """What the candidates of the last :meth:`ask` cost."""
        self._strategy.tell(self._asked, costs)
        self.best = min(self.best, *costs)


def cheapest(
    cost: Callable[[Values], float],
    law: str,
    begin: Values,
    *,
    evaluations: int,
    step: float,
    seed: int,
    enough: float = -math.inf,
) -> tuple[dict[str, float], float]:
    """The cheapest candidate of a search without bounds, and its cost; the first that costs ``enough`` ends it."""
    valley, best, least = Valley(law, begin, step, seed), dict(begin), math.inf
    for _ in range(evaluations // _POPULATION):
        candidates = valley.ask()
        costs = [cost(one) for one in candidates]
        if min(costs) < least:
            least = min(costs)
            best = candidates[costs.index(least)]
        if least <= enough:
            break
        valley.tell(costs)
    return best, least


def search(
    judge: Judge,
    starts: Sequence[Mapping[str, float]],
    *,
    evaluations: int,
    seed: int = 1,
    jobs: int = -1,
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[Judged]:
    """Some ``evaluations`` candidates that were judged, the best first; ``starts`` are among them.

    The gains that are not searched stay as in the first start. The result does not depend on ``jobs``, the number of
    processes; −1 takes all cores.
    """
    different = [dict(one) for place, one in enumerate(starts) if one not in starts[:place]]
    with Parallel(n_jobs=jobs, backend="loky") as parallel:
        found: list[Judged] = list(parallel(delayed(judge.judge)(one) for one in different))
        begins = sorted(found, key=lambda one: one.cost)[: max(1, min(_VALLEYS[0][1], evaluations // _FEWEST))]
        valleys = []
        for place, begin in enumerate(begins):
            valleys.append(Valley(judge.law, begin.gains, _STEP, seed + place, rule=starts[0]))
            valleys[-1].best = begin.cost
        while len(found) < evaluations:
            number = next(number for until, number in _VALLEYS if len(found) < until * evaluations)
            valleys = sorted((one for one in valleys if not one.exhausted), key=lambda valley: valley.best)[:number]
            if not valleys:
                break
            bar = min(one.cost for one in found) + _HOPELESS
            asked = [valley.ask() for valley in valleys]
            judgements = iter(parallel(delayed(judge.judge)(one, bar) for gains in asked for one in gains))
            for valley, gains in zip(valleys, asked, strict=True):
                judged = [next(judgements) for _ in gains]
                valley.tell([one.cost for one in judged])
                found += judged
            progress(min(1.0, len(found) / evaluations))
    return sorted(found, key=lambda one: one.cost)
