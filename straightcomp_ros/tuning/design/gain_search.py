"""Search for gains by CMA-ES, in logarithms, with the same result for the same seed on one machine.

CMA-ES (Hansen and Ostermeier, Evolutionary Computation 9(2), 2001; the package `cma`) ranks candidates only, so that
neither the noise of a peak-to-peak nor the step to infeasible gains disturbs it. The cost has several valleys: a fast
observer with a slow surface may be worth as much as the reverse. One search begins at each of the best starts; the
worse searches are given up on the way.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from joblib import Parallel, delayed

from straightcomp_ros.tuning.design.judged_gains import Judge, Judgement
from straightcomp_ros.tuning.design.searched_gains import SEARCHED, SearchedGain

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
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[Found]:
    """The candidates that were judged, the best first; ``starts`` are among them.

    Args:
        judge: of the stage.
        starts: gains by dotted name, of the same names; those that are not searched stay as in the first.
        evaluations: candidates, about.
        seed: of the candidates.
        jobs: processes; −1 takes all cores. The result does not depend on it.
        progress: called with the fraction that is done.
    """
    different = [dict(one) for place, one in enumerate(starts) if one not in starts[:place]]
    with Parallel(n_jobs=jobs, backend="loky") as parallel:
        found = list(map(Found, different, parallel(delayed(judge.judge)(one) for one in different)))
        begins = sorted(found, key=_cost)[: max(1, min(_VALLEYS[0][1], evaluations // _FEWEST))]
        valleys = [_Valley(judge.law, starts[0], begin, seed + place) for place, begin in enumerate(begins)]
        while len(found) < evaluations:
            number = next(number for until, number in _VALLEYS if len(found) < until * evaluations)
            valleys = sorted((one for one in valleys if not one.exhausted), key=lambda valley: valley.best)[:number]
            if not valleys:
                break
            bar = min(map(_cost, found)) + _HOPELESS
            asked = [valley.ask() for valley in valleys]
            judgements = iter(parallel(delayed(judge.judge)(one, bar) for gains in asked for one in gains))
            for valley, gains in zip(valleys, asked, strict=True):
                judged = [Found(one, next(judgements)) for one in gains]
                valley.tell([_cost(one) for one in judged])
                found += judged
            progress(min(1.0, len(found) / evaluations))
    return sorted(found, key=_cost)


def _cost(found: Found) -> float:
    return found.judgement.cost


class _Valley:
    """One search, from the gains of ``begin``; the bounds of the gains are relative to those of ``rule``."""

    def __init__(self, law: str, rule: Mapping[str, float], begin: Found, seed: int) -> None:
        from cma import CMAEvolutionStrategy

        searched = [gain for gain in SEARCHED[law] if gain.name in rule]
        low, high = zip(*(_bounds(gain, rule[gain.name]) for gain in searched), strict=True)
        first = [math.log(begin.gains[gain.name]) for gain in searched]
        inside = [min(max(x, least), most) for x, least, most in zip(first, low, high, strict=True)]
        options = {"seed": seed, "popsize": _POPULATION, "bounds": [list(low), list(high)], "verbose": -9}
        self._rule, self._names = rule, [gain.name for gain in searched]
        self._strategy = CMAEvolutionStrategy(inside, _STEP, options)
        self._asked: list[Sequence[float]] = []
        self.best = begin.judgement.cost

    @property
    def exhausted(self) -> bool:
        """Whether further candidates would be the same."""
        return bool(self._strategy.stop())

    def ask(self) -> list[dict[str, float]]:
        """The next candidates."""
        self._asked = self._strategy.ask()
        return [{**self._rule, **dict(zip(self._names, map(math.exp, one), strict=True))} for one in self._asked]

    def tell(self, costs: Sequence[float]) -> None:
        """What the candidates of the last :meth:`ask` cost."""
        self._strategy.tell(self._asked, costs)
        self.best = min(self.best, *costs)


def _bounds(gain: SearchedGain, start: float) -> tuple[float, float]:
    scale = start if gain.power else 1.0
    return math.log(gain.low * scale), math.log(gain.high * scale)
