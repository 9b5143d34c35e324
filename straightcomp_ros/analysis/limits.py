"""Limits for the figures of a run, from a YAML file:

true_pp_um: 0.5                    # at most
lost_samples: {max: 0}
received_samples: {min: 30000}
latency_p99_us: {max: 400}
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml


class LimitsError(ValueError):
    """A file of limits is refused; the message names the file, the figure and what is allowed."""


class Limit(NamedTuple):
    """Smallest and largest value that is allowed for a figure."""

    name: str
    minimum: float
    maximum: float


class Verdict(NamedTuple):
    """A limit, the figure's value, and whether it is within the limit. A figure that was not recorded fails."""

    limit: Limit
    value: float | None
    passed: bool

    def __str__(self) -> str:
        low, high = self.limit.minimum, self.limit.maximum
        allowed = " and ".join(
            f"{sign} {value:g}" for sign, value in ((">=", low), ("<=", high)) if math.isfinite(value)
        )
        found = "was not recorded" if self.value is None else f"is {self.value:.6g}"
        return f"{self.limit.name} {found}; allowed: {allowed}"


def read_limits(path: str | Path, known: Mapping[str, Any]) -> list[Limit]:
    """Limits of a file, for figures among ``known``.

    Raises:
        LimitsError: the file cannot be read, is no mapping, names an unknown figure or sets no number.
    """
    where = f"limits {path}"
    try:
        tree = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise LimitsError(f"{where}: cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise LimitsError(f"{where}: no YAML: {' '.join(str(error).split())}") from error
    if not isinstance(tree, Mapping) or not tree:
        raise LimitsError(f"{where}: sets no limit; allowed: lines 'FIGURE: MAXIMUM' or 'FIGURE: {{min: …, max: …}}'")
    return [_limit(where, str(name), value, known) for name, value in tree.items()]


def judged(limits: list[Limit], figures: Mapping[str, Any]) -> list[Verdict]:
    """A verdict for each limit, in its order."""
    verdicts = []
    for limit in limits:
        value = figures[limit.name]
        known = value is not None and math.isfinite(value)
        verdicts.append(Verdict(limit, value if known else None, known and limit.minimum <= value <= limit.maximum))
    return verdicts


def _limit(where: str, name: str, value: Any, known: Mapping[str, Any]) -> Limit:
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
        raise LimitsError(f"{where}: figure '{name}' is unknown; {hint}")
    given = value if isinstance(value, Mapping) else {"max": value}
    bounds = {key: _number(one) for key, one in given.items()}
    if not bounds or set(bounds) - {"min", "max"} or not all(map(math.isfinite, bounds.values())):
        raise LimitsError(f"{where}: {name}: {value!r}; allowed: a number, or {{min: number, max: number}}")
    limit = Limit(name, bounds.get("min", -math.inf), bounds.get("max", math.inf))
    if limit.minimum > limit.maximum:
        raise LimitsError(f"{where}: {name}: min {limit.minimum:g} is above max {limit.maximum:g}")
    return limit


def _number(value: Any) -> float:
    """NaN for what is no number. YAML 1.1 reads 1e-6 as a text."""
    try:
        return math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        return math.nan
