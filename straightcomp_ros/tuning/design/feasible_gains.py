"""Gains that hold linear demands, found without a simulation, or a refusal that says what would have to change.

Two kinds of gains are found so: a start for the search of a design (`FeasibleGains`), and the safe law of a machine
that is hardly known (`safe_law`), which is stable at every corner of what its description leaves open. For the safe law
`linear` alone is taken. It has no model of friction or of the delay that could be wrong, and does not answer to the
measured current, in which a readback's error would come back. Its gains are those with the fastest decay at the worst
of all corners of mass, force, air gap, amplifier and delay; they leave micrometres of error, and serve to identify the
machine. Friction is left out there and then checked in simulated strokes: a law with an integral could hunt around it.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from straightcomp_ros.control.laws import make_law
from straightcomp_ros.control.margins import bisected, closed_loop, linearised, spectral_radius, with_modes_off
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.stage.description import Factors, StageParameters, UncertaintyParameters, deviating
from straightcomp_ros.tuning.design.gain_search import SHORT, cheapest, prepared_stroke, shortened
from straightcomp_ros.tuning.design.gains import (
    SEARCHED,
    Values,
    rule,
    scaled,
    scaled_facts,
    shapes_for,
    starts,
    with_gains,
)
from straightcomp_ros.tuning.design.stability import STANDARD, Corner, Demands, StabilityCheck, corner_at, corners_of

_EVALUATIONS, _IN_BISECTION = 200, 80
_STEP = 0.25
_VALLEYS = 2
"""Starts from which a search is made: one alone may end in a valley without feasible gains."""
_MISSED = 3
LAW = "linear"
_LEAST_DECAY = 0.004
"""Of the slowest mode at the worst corner, in 1/T_d."""
_KEPT = 0.5
"""Of a mode's own decay, least damped, that the safe law leaves it."""
_SAFE_EVALUATIONS, _SAFE_IN_BISECTION = 600, 200
_SAFE_STEP = 0.4
_SHORT = 6.0
"""s; of the strokes with friction."""
_WORST = 6
"""Corners that run strokes, each with the least and the most friction."""
_HARMLESS = 3.0
"""Times the amplitude that a verdict calls an oscillation. The rounding of an encoder keeps a platform without friction
swinging by one or two counts, which does not hinder its identification; what hunts around friction swings by tens."""
_TRAVEL = 0.5
"""Largest excursion in these strokes, relative to the stop."""


class DesignError(ValueError):
    """No gains hold the demands; the message says what would have to change."""


def _least_change(possible: Callable[[float], bool], halvings: int, tries: Sequence[float] = (1.0,)) -> float | None:
    """The least share of a change of the stage, of 0 to 1, with which it is feasible; None if none of ``tries`` is."""
    good = next(filter(possible, tries), None)
    return None if good is None else bisected(possible, good, 0.0, halvings)


class FeasibleGains:
    """Finds gains of ``law`` on the stage of ``scenario`` that hold the demands."""

    def __init__(self, scenario: Scenario, law: str, demands: Demands = STANDARD, seed: int = 1) -> None:
        self._law, self._seed, self._control = law, seed, next(iter(scenario.controls.values()))
        self._check = StabilityCheck(scenario.description, demands)

    def violation(self, gains: Values) -> float:
        """By how much ``gains`` miss the demands; infinite for those that are refused."""
        try:
            return self._check.violation(with_gains(self._control, self._law, gains))
        except ParameterError:
            return math.inf

    def near(self, start: Values, evaluations: int = _EVALUATIONS) -> dict[str, float] | None:
        """Gains near ``start`` that hold the demands: ``start`` itself if it does; None if two searches found none."""
        if self.violation(start) == 0.0:
            return dict(start)
        begins = sorted(starts(self._law, start), key=self.violation)[:_VALLEYS]
        return next((found for begin in begins if (found := self._searched(begin, evaluations))), None)

    def corrected(self, begins: Sequence[Values]) -> list[dict[str, float]]:
        """``begins`` in their order, but gains near by in the place of those that miss a demand.

        They are of different valleys, and a search that begins outside the demands may not find back into its own.
        Where no gains near by hold the demands, they stay as they are.
        """
        return [
            dict(one) if self.violation(one) == 0.0 else self._searched(one, _IN_BISECTION) or dict(one)
            for one in begins
        ]

    def _searched(self, begin: Values, evaluations: int) -> dict[str, float] | None:
        """The first gains without a violation that a search from ``begin`` comes upon."""
        gains, left = cheapest(
            self.violation, self._law, begin, evaluations=evaluations, step=_STEP, seed=self._seed, enough=0.0
        )
        return gains if left == 0.0 else None


def refusal(scenario: Scenario, law: str, seed: int = 1) -> DesignError:
    """The error for a stage on which no gains near the rule hold the demands: each single change that would help.

    Some 20 s of work: each change is bisected with a search at each step.
    """
    stage = scenario.description
    rate, delay, amplifier, bias = stage.rate, stage.drive.delay, stage.drive.bandwidth, stage.actuator.bias_current
    ranges = ("uncertainty.mass", "uncertainty.force", "uncertainty.air_gap")
    # The sentence, the facts that change, the present value in the sentence, and the furthest factor that is tried.
    changes = [
        ("a delay of at most {} samples", ("drive.delay",), delay, 0.05),
        ("an amplifier of at least {} Hz", ("drive.bandwidth",), amplifier, 30.0),
        ("a rate of at least {} Hz", ("rate",), rate, min(20_000.0, 10.0 * rate) / rate),
        ("a bias current of at most {} A", ("actuator.bias_current",), bias, 0.1),
        ("an uncertainty of mass, force and air gap {} times as large", ranges, 1.0, 0.1),
    ]
    for words, fact, furthest in (
        ("modes {} times as high", "frequency", 5.0),
        ("modes damped {} times as much", "damping", 20.0),
        ("an uncertainty of the modes' frequencies {} times as large", "frequency_error", 0.05),
    ):
        names = [name for name in ("first", "second") if getattr(stage.platform.modes, name).frequency]
        changes += [(words, tuple(f"platform.modes.{name}.{fact}" for name in names), 1.0, furthest)] if names else []
    helpful, searched = [], {gain.name for gain in SEARCHED[law]}

    def least_share(facts: Sequence[str], furthest: float) -> float | None:
        # Gains that hold with more of the change, and the dead time there: scaled they are nearly right with less.
        like: tuple[dict[str, float], float] | None = None

        def possible(share: float) -> bool:
            nonlocal like
            changed = scaled_facts(stage, facts, furthest**share)
            feasible = FeasibleGains(scenario.on(changed), law, seed=seed)
            lag, gains, evaluations = changed.dead_time, rule(law, changed), _EVALUATIONS
            tries = [one for shape in shapes_for(changed).values() for one in starts(law, {**gains, **shape})]
            if like is not None:
                evaluations = _IN_BISECTION
                nearly = scaled(law, like[0], like[1] / lag)
                tries.append({**nearly, **{name: gains[name] for name in gains if name not in searched}})
            found = feasible.near(min(tries, key=feasible.violation), evaluations)
            like = like if found is None else (found, lag)
            return found is not None

        return _least_change(possible, halvings=5, tries=(1.0, 0.5, 0.25))

    for sentence, facts, present, furthest in changes:
        if present and (share := least_share(facts, furthest)) is not None:
            helpful.append(sentence.format(f"{_outward(present * furthest**share, up=furthest > 1.0):g}"))
    control = with_gains(next(iter(scenario.controls.values())), law, rule(law, stage))
    missed = StabilityCheck(stage).missed(control)
    advice = f"{', or '.join(helpful)} would do" if helpful else "no single change would do"
    return DesignError(
        f"at {rate:g} Hz with a delay of {delay:g} samples, an amplifier of {amplifier:g} Hz and a bias current of "
        f"{bias:g} A no gains of '{law}' have margins (missed first: {'; '.join(missed[:_MISSED])}): {advice}"
    )


def _outward(value: float, *, up: bool) -> float:
    """``value`` with two digits, rounded away from what was not feasible."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return round((math.ceil if up else math.floor)(value / unit - (1e-9 if up else -1e-9)) * unit, 12)


class SafeLaw(NamedTuple):
    """A law that is stable at all corners."""

    values: Mapping[str, float]  # what to set, by dotted name in the node controller
    decay: float  # of the slowest mode at the worst corner, 1/s
    worst: str  # that corner in words
    corners: int  # number of corners
    excursion: float  # largest |y| in the strokes with friction, m
    pp: float  # largest peak-to-peak error in them, m


def safe_law(scenario: Scenario, progress: Callable[[float], None] = lambda fraction: None) -> SafeLaw:
    """The law for the stage of ``scenario`` and its uncertainty; the gains of its controls are not read.

    Raises:
        DesignError: there is none; the message says what must be known better.
        ParameterError: a machine within the uncertainty is impossible.
    """
    stage = scenario.description
    corners = _corners(stage)
    gains, growth = _calmest(scenario, corners, _SAFE_EVALUATIONS)
    progress(0.3)
    if growth > _allowed(stage):
        raise _safe_refusal(scenario, growth)
    worst = sorted(zip(growths(scenario, corners, gains), corners, strict=True), key=lambda one: -one[0])
    law = make_law(with_gains(scenario.controls[LAW], LAW, gains), stage)
    stroke, runs = prepared_stroke(shortened(scenario, SHORT)), []
    ends = (1.0 / stage.uncertainty.friction, stage.uncertainty.friction)
    for (_, corner), friction in itertools.product(worst[:_WORST], ends):
        plant = deviating(corner.stage.plant, Factors(friction=friction))
        run = stroke.run(law, corner.stage.delay, plant=plant)
        oscillates = run.oscillation > _HARMLESS
        if not run.excursion <= _TRAVEL * plant.platform.stop or oscillates:
            what = "oscillates" if oscillates else "leaves half of the travel up to its stop"
            raise DesignError(
                f"the law that is stable at all corners without friction {what} at {corner.name}, friction × "
                f"{friction:g}; friction must be known better ('stage.uncertainty.friction')"
            )
        runs.append(run)
        progress(0.3 + 0.7 * len(runs) / (2 * _WORST))
    excursion, pp = max(run.excursion for run in runs), max(run.pp for run in runs)
    return SafeLaw(gains, -growth * stage.rate, worst[0][1].name, len(corners), excursion, pp)


def _allowed(stage: StageParameters) -> float:
    """Largest logarithm of a pole's radius."""
    return -_LEAST_DECAY * stage.period / stage.dead_time


def _corners(stage: StageParameters) -> list[Corner]:
    """The corners of the uncertainty, and the stage with its modes at the ends of theirs."""
    rung = with_modes_off(stage).items()
    return [*corners_of(stage), *(corner_at(f"modes at {name}", one) for name, one in rung)]


def growths(scenario: Scenario, corners: Sequence[Corner], gains: Values) -> list[float]:
    """Logarithm of the largest pole's radius at each corner; infinite where the law is refused or not linear.

    A mode that the law leaves alone decays as it does by itself: where the whole keeps `_KEPT` of that, what counts is
    the platform without modes.
    """
    try:
        law = linearised(make_law(with_gains(scenario.controls[LAW], LAW, gains), scenario.description))
    except ValueError:
        return [math.inf] * len(corners)
    found = [math.log(spectral_radius(closed_loop(corner.sampled, law))) for corner in corners]
    if not (modes := scenario.description.platform.modes.present):
        return found
    least = -_KEPT * min(2.0 * math.pi * mode.frequency * mode.damping / mode.damping_factor for mode in modes)
    allowed = _allowed(scenario.description)
    left = max(least * scenario.description.period, allowed)
    rigid = [math.log(spectral_radius(closed_loop(corner.rigid, law))) for corner in corners]
    return [one if whole <= left else max(one, allowed + whole - left) for whole, one in zip(found, rigid, strict=True)]


def _calmest(scenario: Scenario, corners: Sequence[Corner], evaluations: int) -> tuple[dict[str, float], float]:
    """Gains with the least growth at their worst corner, and this growth."""

    def growth(gains: Values) -> float:
        return max(growths(scenario, corners, gains))

    shapes = shapes_for(scenario.description)
    shapes.pop("a roll-off", None)  # It lags more than a notch where the loop is slow.
    results = list[tuple[dict[str, float], float]]()
    for shape in shapes.values():
        begin = min(starts(LAW, {**rule(LAW, scenario.description), **shape}), key=growth)
        found = cheapest(growth, LAW, begin, evaluations=evaluations // len(shapes), step=_SAFE_STEP, seed=1)
        results += [(begin, growth(begin)), found]
    return min(results, key=lambda one: one[1])


_RANGES = {
    "the mass within ± {mass:.2g} of it": ("mass",),
    "the force within ± {force:.2g} of it": ("force",),
    "the air gap within ± {air_gap:.2g} of it": ("air_gap",),
    "the amplifier's bandwidth within a factor of {amplifier:.3g}": ("amplifier",),
    "the delay within × {shortest_delay:.2g} to {longest_delay:.2g}": ("shortest_delay", "longest_delay"),
}
"""What could be known better, in words, and the parameters of the uncertainty that say how well it is known."""


def _narrowed(ranges: UncertaintyParameters, names: Sequence[str], width: float) -> UncertaintyParameters:
    """``ranges`` with those of ``names`` narrowed to the share ``width`` of them."""

    def narrow(name: str) -> float:
        value: float = getattr(ranges, name)
        if name == "amplifier":
            return math.pow(value, width)
        # Factors of the delay lie around 1, the others are relative deviations.
        middle = 1.0 if name.endswith("_delay") else 0.0
        return middle + width * (value - middle)

    return dataclasses.replace(ranges, **{name: narrow(name) for name in names})


def _safe_refusal(scenario: Scenario, growth: float) -> DesignError:
    """The error where no law is stable at all corners: which single range, if it were narrower, would allow one."""
    stage, helpful = scenario.description, []
    for words, names in _RANGES.items():
        if _narrowed(stage.uncertainty, names, 0.0) == stage.uncertainty:
            continue

        def possible(share: float, names: Sequence[str] = names) -> bool:
            changed = dataclasses.replace(stage, uncertainty=_narrowed(stage.uncertainty, names, 1.0 - share))
            try:
                corners = _corners(changed)
            except ParameterError:
                return False
            return _calmest(scenario.on(changed), corners, _SAFE_IN_BISECTION)[1] <= _allowed(changed)

        share = _least_change(possible, halvings=4)
        if share is not None:
            helpful.append(words.format(**dataclasses.asdict(_narrowed(stage.uncertainty, names, 1.0 - share))))
    advice = f"must be known better: {', or '.join(helpful)}" if helpful else "no single fact would be enough"
    return DesignError(
        f"no gains of '{LAW}' are stable at all corners of 'stage.uncertainty' (at best the slowest "
        f"mode decays with {-growth * stage.rate:.3g} 1/s; allowed: >= {-_allowed(stage) * stage.rate:.3g}): {advice}"
    )
