"""Figures of the steps with what is allowed for each."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from straightcomp_ros.tuning.commissioning.timing_budget import allowed_cost_um

_FEW = 1.0 / 200.0
"""Of the samples of a stroke, those that may be without a command: the law then leaves 0.16 µm in place of 0.14 µm."""
_LAST_BITS = 1e-9
"""Relative difference from a limit that is rounding."""


class Check(NamedTuple):
    """A figure of a step, None where an older record lacks it, with what is allowed, and whether it is."""

    step: str
    name: str
    value: float | None
    allowed: str
    passed: bool

    def __str__(self) -> str:
        return f"{self.name} {_shown(self.value)} (allowed: {self.allowed})"


def at_least(step: str, name: str, value: float | None, low: float) -> Check:
    """A figure that must reach ``low``."""
    return Check(step, name, value, f">= {low:.4g}", value is not None and _reaches(value, low))


def at_most(step: str, name: str, value: float | None, high: float) -> Check:
    """A figure that must not exceed ``high``."""
    return Check(step, name, value, f"<= {high:.4g}", value is not None and _reaches(high, value))


def stroke_checks(accepted: Mapping[str, Any], count: float) -> Iterator[Check]:
    """How well the host served the stroke of `acceptance`, from its figures; ``count`` of the encoder in m."""
    yield at_most("acceptance", "lost samples of the stroke", accepted.get("lost_samples"), 0.0)
    few = float(math.ceil(_FEW * accepted["samples"]))
    yield at_most("acceptance", "samples of the stroke without a command", accepted.get("lost_commands"), few)
    timing = accepted["timing"]
    if "as_measured_costs_um" in timing:
        # A record that was read again has no infinity.
        cost = math.inf if timing["as_measured_costs_um"] is None else timing["as_measured_costs_um"]
        yield at_most("acceptance", "what its latencies cost [µm p-p]", cost, allowed_cost_um(timing, count))


def _reaches(value: float, limit: float) -> bool:
    return value >= limit or math.isclose(value, limit, rel_tol=_LAST_BITS)


def _shown(value: float | None) -> str:
    if value is None:
        return "unknown"
    return f"{value:.4g}" if math.isfinite(value) else "infinite, since the platform is lost"
