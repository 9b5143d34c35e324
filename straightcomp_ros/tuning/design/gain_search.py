"""Search for gains by CMA-ES, in logarithms, with the same result for the same seed on one machine.

CMA-ES (Hansen and Ostermeier, Evolutionary Computation 9(2), 2001; the package `cma`) ranks candidates only, so that
neither the noise of a peak-to-peak nor the step to infeasible gains disturbs it. The cost of simulated strokes has
several valleys: a fast observer with a slow surface may be worth as much as the reverse. One search begins at each of
the best starts; the worse searches are given up on the way.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from joblib import Parallel, delayed

from straightcomp_ros.tuning.design.gains import SEARCHED, SHAPES, Values
from straightcomp_ros.tuning.design.judged_gains import Judge, Judgement

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
            first = [min(max(x, least), most) for x, least, most in zip(first, low, high, strict=True)]
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
    """Some ``evaluations`` candidates that were judged, the best first; ``starts`` are among them.

    The gains that are not searched stay as in the first start. The result does not depend on ``jobs``, the number of
    processes; −1 takes all cores.
    """
    different = [dict(one) for place, one in enumerate(starts) if one not in starts[:place]]
    with Parallel(n_jobs=jobs, backend="loky") as parallel:
        found = list(map(Found, different, parallel(delayed(judge.judge)(one) for one in different)))
        begins = sorted(found, key=_cost)[: max(1, min(_VALLEYS[0][1], evaluations // _FEWEST))]
        valleys = []
        for place, begin in enumerate(begins):
            valleys.append(Valley(judge.law, begin.gains, _STEP, seed + place, rule=starts[0]))
            valleys[-1].best = _cost(begin)
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
