"""Search for gains by CMA-ES, in logarithms, with the same result for the same seed on one machine.

CMA-ES (Hansen and Ostermeier, Evolutionary Computation 9(2), 2001; the package `cma`) ranks candidates only, so that
neither the noise of a peak-to-peak nor the step to infeasible gains disturbs it.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from joblib import Parallel, delayed

from straightcomp_ros.design.judged_gains import Judge, Judgement
from straightcomp_ros.design.searched_gains import SEARCHED, SearchedGain

_FIRST_STEP = 0.2
"""Standard deviation of the first candidates' logarithms: a fifth of the gain."""
_POPULATION = 10


class Found(NamedTuple):
    """Gains by dotted name, and what they are worth."""

    gains: Mapping[str, float]
    judgement: Judgement


def search(
    judge: Judge,
    starts: Sequence[Mapping[str, float]],
    *,
    evaluations: int,
    seed: int = 1,
    jobs: int = -1,
    step: float = _FIRST_STEP,
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[Found]:
    """The candidates that were judged, the best first; ``starts`` are among them, and the search begins at their best.

    Args:
        judge: of the stage.
        starts: gains by dotted name, of the same names; those that are not searched stay as in the first.
        evaluations: candidates, about.
        seed: of the candidates.
        jobs: processes; −1 takes all cores. The result does not depend on it.
        step: standard deviation of the first candidates' logarithms.
        progress: called with the fraction that is done.
    """
    from cma import CMAEvolutionStrategy

    rule = starts[0]
    searched = [gain for gain in SEARCHED[judge.law] if gain.name in rule]
    bounds = [_bounds(gain, rule[gain.name]) for gain in searched]

    def gains_of(logarithms: Iterable[float]) -> dict[str, float]:
        return {**rule, **{gain.name: math.exp(x) for gain, x in zip(searched, logarithms, strict=True)}}

    with Parallel(n_jobs=jobs, backend="loky") as parallel:
        found = list(map(Found, map(dict, starts), parallel(delayed(judge.judge)(one) for one in starts)))
        begin = min(found, key=lambda one: one.judgement.cost).gains
        first = [
            min(max(math.log(begin[gain.name]), low), high) for gain, (low, high) in zip(searched, bounds, strict=True)
        ]
        strategy = CMAEvolutionStrategy(
            first,
            step,
            {
                "seed": seed,
                "popsize": _POPULATION,
                "bounds": [list(side) for side in zip(*bounds, strict=True)],
                "verbose": -9,
            },
        )
        while len(found) < evaluations and not strategy.stop():
            candidates = strategy.ask()
            gains = [gains_of(candidate) for candidate in candidates]
            judgements = parallel(delayed(judge.judge)(one) for one in gains)
            strategy.tell(candidates, [judgement.cost for judgement in judgements])
            found += map(Found, gains, judgements)
            progress(min(1.0, len(found) / evaluations))
    return sorted(found, key=lambda one: one.judgement.cost)


def _bounds(gain: SearchedGain, start: float) -> tuple[float, float]:
    scale = start if gain.power else 1.0
    return math.log(gain.low * scale), math.log(gain.high * scale)
