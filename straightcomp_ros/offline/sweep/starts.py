"""Figures of a stroke over several starts: what is published of a stroke is their median, with its range.

A peak-to-peak is one extreme of 30,000 samples. It moves by some hundredths of a µm when a sample falls on the next
count of the encoder, or when another processor rounds another last bit, so that the figure of one run says less than
its digits. A start is the place where the platform stands when the amplifier is switched on: nothing else differs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from straightcomp_ros.analysis.metrics import Metrics, evaluate
from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.sweep.compiled_stroke import can_run, run_stroke
from straightcomp_ros.straightness.guide_map import StraightnessMap

STARTS = 9
"""Of a published figure."""
PITCH = 0.13e-6
"""Distance of neighbouring starts in m: not a multiple of the encoder's 0.1 µm, so each lies elsewhere in a count."""


class Spread(NamedTuple):
    """A figure over several starts, in the unit of its numbers."""

    median: float
    min: float
    max: float

    def scaled(self, factor: float) -> Spread:
        """The same in another unit; ``factor`` > 0."""
        return Spread(*(number * factor for number in self))

    def text(self, digits: int) -> str:
        """``median (min to max)`` with so many decimals; the median alone where the range is within the last one."""
        median, least, greatest = (f"{number:.{digits}f}" for number in self)
        return median if least == greatest else f"{median} ({least} to {greatest})"


def spread(numbers: Iterable[float]) -> Spread:
    """Median and range of at least one number."""
    found = list(numbers)
    return Spread(float(np.median(found)), min(found), max(found))


def offsets(count: int = STARTS) -> tuple[float, ...]:
    """Of the platform at its start from where the parameters have it, in m: none, then to either side by turns."""
    return tuple(PITCH * ((k + 1) // 2) * (1 if k % 2 else -1) for k in range(count))


def values_of_starts(values: Mapping[str, Mapping[str, Any]], count: int = STARTS) -> list[dict[str, dict[str, Any]]]:
    """Parameters by node and dotted name for each start; the first are ``values`` themselves."""
    initial = float(values.get("driver", {}).get("simulated.initial_y", 0.0))
    copies: list[dict[str, dict[str, Any]]] = []
    for offset in offsets(count):
        one = {node: dict(parameters) for node, parameters in values.items()}
        one.setdefault("driver", {})["simulated.initial_y"] = initial + offset
        copies.append(one)
    return copies


def first_cycle(values: Mapping[str, Mapping[str, Any]]) -> tuple[StrokeRecord, StraightnessMap]:
    """The first cycle under ``values`` and the controller's map: compiled where the compiled loop models it.

    Raises:
        ParameterError, SurveyError: the parameters are refused.
        ValueError: the platform's position, or the current, was not finite.
    """
    if can_run(values):
        return run_stroke(values)
    simulation = Simulation(values)
    return simulation.run(), simulation.map


def metrics_of_starts(
    values: Mapping[str, Mapping[str, Any]],
    count: int = STARTS,
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[Metrics]:
    """Figures of the first cycle from each start, in the order of :func:`offsets`.

    Args:
        values: parameters by node and dotted name.
        count: starts, at least one.
        progress: called with the fraction that is done.

    Raises:
        ParameterError, SurveyError: the parameters are refused.
        MetricsError: the stage does not move.
        ValueError: the platform's position, or the current, was not finite.
    """
    found = []
    for number, one in enumerate(values_of_starts(values, count), 1):
        found.append(evaluate(*first_cycle(one)))
        progress(number / count)
    return found


def spreads(shown: Iterable[Mapping[str, float | None]]) -> dict[str, Spread]:
    """Each figure of `Metrics.to_display` over several starts, by its name; those that a start lacks are left out."""
    rows = list(shown)
    spread_of: dict[str, Spread] = {}
    for name in rows[0]:
        numbers = [row[name] for row in rows]
        present = [number for number in numbers if number is not None]
        if len(present) == len(rows):
            spread_of[name] = spread(present)
    return spread_of
