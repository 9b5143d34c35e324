"""Gains that hold the linear demands, or a refusal that says what would have to change, computed."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.design.searched_gains import SEARCHED, rule, scaled, starts, with_gains
from straightcomp_ros.tuning.design.stability_demands import STANDARD, Demands, StabilityCheck

_EVALUATIONS = 200
_IN_BISECTION = 80
_STEP = 0.25
_VALLEYS = 2
"""Starts from which a search is made: one alone may end beside the feasible gains."""
_HALVINGS = 5
_MISSED = 3


class DesignError(ValueError):
    """No gains hold the demands; the message says what would have to change."""


def feasible_gains(
    scenario: Scenario,
    law: str,
    start: Mapping[str, float],
    demands: Demands = STANDARD,
    *,
    evaluations: int = _EVALUATIONS,
    seed: int = 1,
) -> dict[str, float] | None:
    """Gains near ``start`` that hold the demands: ``start`` itself if it does; None if a search found none.

    Args:
        scenario: the stage.
        law: name of the law.
        start: gains by dotted name.
        demands: what is asked for.
        evaluations: of each of two searches, which simulate nothing.
        seed: of the search.
    """
    violation = _violation(scenario, law, demands)
    if violation(start) == 0.0:
        return dict(start)
    for begin in sorted(starts(law, start), key=violation)[:_VALLEYS]:
        found = _mended(violation, law, begin, evaluations, seed)
        if found is not None:
            return found
    return None


def mended_starts(
    scenario: Scenario, law: str, begins: Sequence[Mapping[str, float]], demands: Demands = STANDARD, *, seed: int = 1
) -> list[dict[str, float]]:
    """``begins`` in their order, but gains near by in the place of those that miss a demand.

    They are of different valleys, and a search that begins outside the demands may not find back into its own. Where no
    gains near by hold the demands, they stay as they are.
    """
    violation = _violation(scenario, law, demands)
    return [
        dict(one) if violation(one) == 0.0 else _mended(violation, law, one, _IN_BISECTION, seed) or dict(one)
        for one in begins
    ]


def _violation(scenario: Scenario, law: str, demands: Demands) -> Callable[[Mapping[str, float]], float]:
    check = StabilityCheck(scenario.description, demands)
    control = next(iter(scenario.controls.values()))

    def violation(gains: Mapping[str, float]) -> float:
        try:
            return check.violation(with_gains(control, law, gains))
        except ParameterError:
            return math.inf

    return violation


def _mended(
    violation: Callable[[Mapping[str, float]], float],
    law: str,
    begin: Mapping[str, float],
    evaluations: int,
    seed: int,
) -> dict[str, float] | None:
    """The first gains without a violation that a search from ``begin`` comes upon."""
    from cma import CMAEvolutionStrategy

    names = [gain.name for gain in SEARCHED[law] if gain.name in begin]
    strategy = CMAEvolutionStrategy(
        [math.log(begin[name]) for name in names], _STEP, {"seed": seed, "popsize": 10, "verbose": -9}
    )
    for _ in range(evaluations // 10):
        candidates = strategy.ask()
        gains = [{**begin, **dict(zip(names, map(math.exp, one), strict=True))} for one in candidates]
        violations = [violation(one) for one in gains]
        if 0.0 in violations:
            return gains[violations.index(0.0)]
        strategy.tell(candidates, violations)
    return None


class _Change(NamedTuple):
    """A change of the stage: its sentence with the value to fill in, its present value, the furthest that is tried.

    Where the furthest is not feasible, what lies half way to it is tried, and a quarter.
    """

    sentence: str
    value: float
    furthest: float
    apply: Callable[[StageParameters, float], StageParameters]


def refusal(scenario: Scenario, law: str, demands: Demands = STANDARD, *, seed: int = 1) -> DesignError:
    """The error for a stage on which :func:`feasible_gains` found none: each single change that would help.

    Some 20 s of work: each change is bisected with a search at each step.
    """
    stage = scenario.description
    rate, delay, amplifier, bias = stage.rate, stage.drive.delay, stage.drive.bandwidth, stage.actuator.bias_current
    changes = (
        _Change("a delay of at most {} samples", delay, 0.05 * delay, _with_delay),
        _Change("an amplifier of at least {} Hz", amplifier, 30.0 * amplifier, _with_amplifier),
        _Change("a rate of at least {} Hz", rate, min(20_000.0, 10.0 * rate), _with_rate),
        _Change("a bias current of at most {} A", bias, 0.1 * bias, _with_bias),
        _Change("an uncertainty of mass, force and air gap {} times as large", 1.0, 0.1, _with_uncertainty),
    )
    helpful = [text for change in changes if (text := _threshold(scenario, law, demands, change, seed))]
    control = with_gains(next(iter(scenario.controls.values())), law, rule(law, stage))
    missed = StabilityCheck(stage, demands).missed(control)
    advice = f"{', or '.join(helpful)} would do" if helpful else "no single change would do"
    return DesignError(
        f"at {rate:g} Hz with a delay of {delay:g} samples, an amplifier of {amplifier:g} Hz and a bias current of "
        f"{bias:g} A no gains of '{law}' have margins (missed first: {'; '.join(missed[:_MISSED])}): {advice}"
    )


def _threshold(scenario: Scenario, law: str, demands: Demands, change: _Change, seed: int) -> str:
    """The sentence with the value nearest to the present one that is feasible, empty if even the furthest is not."""

    def possible(value: float, like: dict[str, float] | None, lag: float) -> tuple[dict[str, float] | None, float]:
        """Gains that hold the demands, and their dead time; ``like`` held them at the dead time ``lag``."""
        changed = scenario.on(change.apply(scenario.description, value))
        control = next(iter(changed.controls.values()))
        now = changed.description.dead_time
        gains = rule(law, changed.description)
        tries = starts(law, gains)
        if like is not None:
            # What held a little farther from the border is nearly right here.
            nearly = scaled(law, like, lag / now)
            tries.append({**gains, **{gain.name: nearly[gain.name] for gain in SEARCHED[law]}})
        check = StabilityCheck(changed.description, demands)
        begin = min(tries, key=lambda one: check.violation(with_gains(control, law, one)))
        evaluations = _EVALUATIONS if like is None else _IN_BISECTION
        return feasible_gains(changed, law, begin, demands, evaluations=evaluations, seed=seed), now

    bad = change.value
    for part in (1.0, 0.5, 0.25):
        good = bad * (change.furthest / bad) ** part
        held, lag = possible(good, None, 1.0)
        if held is not None:
            break
    else:
        return ""
    for _ in range(_HALVINGS):
        middle = math.sqrt(good * bad)
        found, there = possible(middle, held, lag)
        if found is None:
            bad = middle
        else:
            good, held, lag = middle, found, there
    return change.sentence.format(f"{_outward(good, up=change.furthest > change.value):g}")


def _outward(value: float, *, up: bool) -> float:
    """``value`` with two digits, rounded away from what was not feasible."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return round((math.ceil if up else math.floor)(value / unit - (1e-9 if up else -1e-9)) * unit, 12)


def _with_delay(stage: StageParameters, delay: float) -> StageParameters:
    return dataclasses.replace(stage, drive=dataclasses.replace(stage.drive, delay=delay))


def _with_amplifier(stage: StageParameters, bandwidth: float) -> StageParameters:
    return dataclasses.replace(stage, drive=dataclasses.replace(stage.drive, bandwidth=bandwidth))


def _with_bias(stage: StageParameters, bias: float) -> StageParameters:
    return dataclasses.replace(stage, actuator=dataclasses.replace(stage.actuator, bias_current=bias))


def _with_rate(stage: StageParameters, rate: float) -> StageParameters:
    return dataclasses.replace(stage, rate=round(rate))


def _with_uncertainty(stage: StageParameters, factor: float) -> StageParameters:
    ranges = stage.uncertainty
    smaller = {name: factor * getattr(ranges, name) for name in ("mass", "force", "air_gap")}
    return dataclasses.replace(stage, uncertainty=dataclasses.replace(ranges, **smaller))
