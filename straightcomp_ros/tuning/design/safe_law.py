"""A slow law for a machine that is hardly known: stable at every corner of what the description leaves open.

Law `linear` alone is taken. It has no model of friction or of the delay that could be wrong, and does not answer to the
measured current, in which a readback's error would come back. Its gains are those with the fastest decay at the worst
of all corners of mass, force, air gap, amplifier and delay; they leave micrometres of error, and serve to identify the
machine. Friction is left out there and then checked in simulated strokes: a law with an integral could hunt around it.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.margins import StateSpace, closed_loop, linearised, sampled_plant, spectral_radius
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping, to_mapping
from straightcomp_ros.stage.description import Factors, StageParameters, UncertaintyParameters, deviating
from straightcomp_ros.tuning.design.feasible_gains import DesignError
from straightcomp_ros.tuning.design.prepared_stroke import prepared_stroke, shortened
from straightcomp_ros.tuning.design.searched_gains import SEARCHED, rule, starts, with_gains

LAW = "linear"
_LEAST_DECAY = 0.004
"""Of the slowest mode at the worst corner, in 1/T_d."""
_EVALUATIONS = 600
_IN_BISECTION = 200
_HALVINGS = 4
_STEP = 0.4
_SHORT = 6.0
"""s; of the strokes with friction."""
_WORST = 6
"""Corners that run strokes, each with the least and the most friction."""
_TRAVEL = 0.5
"""Largest excursion in these strokes, relative to the stop."""


@dataclass(frozen=True)
class SafeLaw:
    """A law that is stable at all corners.

    Attributes:
        values: what to set, by dotted name in the node controller.
        decay: of the slowest mode at the worst corner, 1/s.
        worst: that corner in words.
        corners: number of corners.
        excursion: largest |y| in the strokes with friction, m.
        pp: largest peak-to-peak error in them, m.
    """

    values: Mapping[str, float]
    decay: float
    worst: str
    corners: int
    excursion: float
    pp: float


class _Corner(NamedTuple):
    """A machine at a corner: in words, itself, its plant sampled, the delay in samples."""

    name: str
    machine: PlantParameters
    plant: StateSpace
    delay: float


def safe_law(
    scenario: Scenario, *, seed: int = 1, progress: Callable[[float], None] = lambda fraction: None
) -> SafeLaw:
    """The law for the stage of ``scenario`` and its uncertainty.

    Args:
        scenario: the stage; its controls' gains are not read.
        seed: of the search.
        progress: called with the fraction that is done.

    Raises:
        DesignError: there is none; the message says what must be known better.
        ParameterError: a machine within the uncertainty is impossible.
    """
    stage = scenario.description
    corners = _corners(stage)
    gains, growth = _calmest(scenario, corners, _EVALUATIONS, seed)
    progress(0.3)
    if growth > _allowed(stage):
        raise _refusal(scenario, growth, seed)
    growths = _growths(scenario, corners, gains)
    worst = sorted(zip(growths, corners, strict=True), key=lambda one: -one[0])
    law = make_law(with_gains(scenario.controls[LAW], LAW, gains), stage)
    course = prepared_stroke(scenario, shortened(scenario, _SHORT))
    excursion = pp = 0.0
    ends = (1.0 / stage.uncertainty.friction, stage.uncertainty.friction)
    for number, ((_, corner), friction) in enumerate(itertools.product(worst[:_WORST], ends), 1):
        plant = deviating(corner.machine, Factors(friction=friction))
        run = course.run(law, corner.delay * stage.period, plant=plant)
        swings = run.oscillation > 1.0
        if not run.excursion <= _TRAVEL * plant.platform.stop or swings:
            what = "oscillates" if swings else "leaves half of the travel up to its stop"
            raise DesignError(
                f"the law that is stable at all corners without friction {what} at {corner.name}, friction × "
                f"{friction:g}; friction must be known better ('stage.uncertainty.friction')"
            )
        excursion, pp = max(excursion, run.excursion), max(pp, run.pp)
        progress(0.3 + 0.7 * number / (2 * _WORST))
    return SafeLaw(gains, -growth * stage.rate, worst[0][1].name, len(corners), excursion, pp)


def _allowed(stage: StageParameters) -> float:
    """Largest logarithm of a pole's radius."""
    return -_LEAST_DECAY * stage.period / stage.dead_time


def _corners(stage: StageParameters) -> list[_Corner]:
    ranges = stage.uncertainty
    sides = {
        "mass": (1.0 - ranges.mass, 1.0 + ranges.mass),
        "force": (1.0 - ranges.force, 1.0 + ranges.force),
        "gap": (1.0 - ranges.air_gap, 1.0 + ranges.air_gap),
        "amplifier": (1.0 / ranges.amplifier, ranges.amplifier),
        "delay": (min(1.0, ranges.shortest_delay), max(1.0, ranges.longest_delay)),
    }
    found = []
    for factors in itertools.product(*(sorted(set(side)) for side in sides.values())):
        mass, force, gap, amplifier, late = factors
        machine = deviating(stage.plant, Factors(mass, force, gap, amplifier=amplifier))
        corner = dataclasses.replace(stage, platform=machine.platform, actuator=machine.actuator, drive=machine.drive)
        delay = late * stage.drive.delay
        name = ", ".join(f"{side} × {factor:g}" for side, factor in zip(sides, factors, strict=True))
        found.append(_Corner(name, machine, sampled_plant(corner, delay * stage.period), delay))
    return found


def _growths(scenario: Scenario, corners: list[_Corner], gains: Mapping[str, float]) -> list[float]:
    """Logarithm of the largest pole's radius at each corner; infinite where the law is refused or not linear."""
    try:
        # A gain beyond its range is refused, as a node would.
        control = from_mapping(ControlParameters, to_mapping(with_gains(scenario.controls[LAW], LAW, gains)))
        law = linearised(make_law(control, scenario.description))
    except ValueError:
        return [math.inf] * len(corners)
    return [math.log(spectral_radius(closed_loop(corner.plant, law))) for corner in corners]


def _calmest(scenario: Scenario, corners: list[_Corner], evaluations: int, seed: int) -> tuple[dict[str, float], float]:
    """Gains with the least growth at their worst corner, and this growth."""
    from cma import CMAEvolutionStrategy

    begin = rule(LAW, scenario.description)
    names = [gain.name for gain in SEARCHED[LAW]]

    def growth(gains: Mapping[str, float]) -> float:
        return max(_growths(scenario, corners, gains))

    best = min(starts(LAW, begin), key=growth)
    least = growth(best)
    strategy = CMAEvolutionStrategy(
        [math.log(best[name]) for name in names], _STEP, {"seed": seed, "popsize": 10, "verbose": -9}
    )
    for _ in range(evaluations // 10):
        candidates = strategy.ask()
        gains = [{**best, **dict(zip(names, map(math.exp, one), strict=True))} for one in candidates]
        growths = [growth(one) for one in gains]
        strategy.tell(candidates, growths)
        if min(growths) < least:
            least = min(growths)
            best = gains[growths.index(least)]
    return best, least


def _refusal(scenario: Scenario, growth: float, seed: int) -> DesignError:
    """The error where no law is stable at all corners: which single range, if it were narrower, would allow one."""
    helpful = []
    for name, text, narrowed in _RANGES:
        present = narrowed(scenario.description.uncertainty, 1.0)
        if present == narrowed(scenario.description.uncertainty, 0.0):
            continue
        good, bad = 0.0, 1.0
        if not _stable(scenario, narrowed, good, seed):
            continue
        for _ in range(_HALVINGS):
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if _stable(scenario, narrowed, middle, seed) else (good, middle)
        helpful.append(f"{name} {text(narrowed(scenario.description.uncertainty, good))}")
    stage = scenario.description
    advice = f"must be known better: {', or '.join(helpful)}" if helpful else "no single fact would be enough"
    return DesignError(
        f"no gains of '{LAW}' are stable at all corners of 'stage.uncertainty' (at best the slowest "
        f"mode decays with {-growth * stage.rate:.3g} 1/s; allowed: >= {-_allowed(stage) * stage.rate:.3g}): {advice}"
    )


def _stable(
    scenario: Scenario,
    narrowed: Callable[[UncertaintyParameters, float], UncertaintyParameters],
    share: float,
    seed: int,
) -> bool:
    stage = scenario.description
    changed = scenario.on(dataclasses.replace(stage, uncertainty=narrowed(stage.uncertainty, share)))
    try:
        corners = _corners(changed.description)
    except ParameterError:
        return False
    return _calmest(changed, corners, _IN_BISECTION, seed)[1] <= _allowed(stage)


def _of_fraction(name: str) -> Callable[[UncertaintyParameters, float], UncertaintyParameters]:
    return lambda ranges, share: dataclasses.replace(ranges, **{name: share * getattr(ranges, name)})


def _delay(ranges: UncertaintyParameters, share: float) -> UncertaintyParameters:
    """The range of the delay, narrowed to ``share`` of its width around 1."""
    shortest, longest = (1.0 + share * (one - 1.0) for one in (ranges.shortest_delay, ranges.longest_delay))
    return dataclasses.replace(ranges, shortest_delay=shortest, longest_delay=longest)


def _amplifier(ranges: UncertaintyParameters, share: float) -> UncertaintyParameters:
    return dataclasses.replace(ranges, amplifier=ranges.amplifier**share)


_RANGES: tuple[
    tuple[str, Callable[[UncertaintyParameters], str], Callable[[UncertaintyParameters, float], UncertaintyParameters]],
    ...,
] = (
    ("the mass", lambda ranges: f"within ± {ranges.mass:.2g} of it", _of_fraction("mass")),
    ("the force", lambda ranges: f"within ± {ranges.force:.2g} of it", _of_fraction("force")),
    ("the air gap", lambda ranges: f"within ± {ranges.air_gap:.2g} of it", _of_fraction("air_gap")),
    ("the amplifier's bandwidth", lambda ranges: f"within a factor of {ranges.amplifier:.3g}", _amplifier),
    (
        "the delay",
        lambda ranges: f"within × {ranges.shortest_delay:.2g} to {ranges.longest_delay:.2g}",
        _delay,
    ),
)
"""Each range by name, in words, and how it is narrowed."""
