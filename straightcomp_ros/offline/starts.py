"""Figures of a stroke over several starts: a published figure is their median, with their range.

A peak-to-peak is one extreme of 30,000 samples. It moves by some hundredths of a µm when a sample falls on the next
count of the encoder, or when another processor rounds another last bit: one run does not support its digits. A start is
the position of the platform when the amplifier is switched on; nothing else differs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.analysis.metrics import Metrics, evaluate
from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.analysis.run_verdict import verdict_on
from straightcomp_ros.control.law import Law
from straightcomp_ros.offline.scenario import Cycle, Scenario, Stroke, laws_of, make_scenario, node_set
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.straightness.feedforward import along
from straightcomp_ros.straightness.guide_map import StraightnessMap

STARTS = 9
"""Of a published figure."""
PITCH = 0.13e-6
"""Distance of neighbouring starts in m: not a multiple of the encoder's 0.1 µm, so each lies elsewhere in a count."""
COUNTS_APART = 1.3
"""The same in counts, for other encoders."""


class Run(NamedTuple):
    """Law, figures and verdict of a recorded or a simulated run."""

    law: str
    metrics: Metrics
    verdict: Verdict

    def to_display(self) -> dict[str, Any]:
        """Figures and verdict by name."""
        return {**self.metrics.to_display(), **self.verdict._asdict()}


def simulated_run(record: StrokeRecord, straightness: StraightnessMap, values: Values) -> Run:
    """Figures and verdict of a simulated run."""
    return Run(record.law, evaluate(record, straightness), verdict_on(record, straightness, values))


class Spread(NamedTuple):
    """A figure over several starts, in the unit of its numbers."""

    median: float
    min: float
    max: float

    def scaled(self, factor: float) -> Spread:
        """The same in another unit; ``factor`` > 0."""
        return Spread(*(number * factor for number in self))

    def text(self, digits: int) -> str:
        """``median (min to max)`` as :func:`~straightcomp_ros.analysis.figure_words.with_digits` shows them; the median
        alone if the range rounds to it."""
        median, least, greatest = (with_digits(number, digits) for number in self)
        return median if least == greatest else f"{median} ({least} to {greatest})"


def spread(numbers: Iterable[float]) -> Spread:
    """Median and range of at least one number."""
    found = list(numbers)
    return Spread(float(np.median(found)), min(found), max(found))


def spreads(shown: Iterable[Mapping[str, float | None]]) -> dict[str, Spread]:
    """Each figure of `Metrics.to_display` over several starts, by its name; figures that a start lacks are left out."""
    rows = list(shown)
    columns = {name: [number for row in rows if (number := row[name]) is not None] for name in rows[0]}
    return {name: spread(numbers) for name, numbers in columns.items() if len(numbers) == len(rows)}


def with_values(values: Values, node: str, changes: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """A copy of ``values`` with ``changes`` of parameters of ``node``, by dotted name."""
    copied = {name: dict(parameters) for name, parameters in values.items()}
    copied.setdefault(node, {}).update(changes)
    return copied


def offsets(count: int = STARTS) -> tuple[float, ...]:
    """Offsets in m from the start of the parameters: none, then to either side in turn."""
    return tuple(offset(k, PITCH) for k in range(count))


def offset(number: int, pitch: float) -> float:
    """Offset in m of start ``number`` from the first, with ``pitch`` m between neighbours, to either side in turn."""
    return pitch * ((number + 1) // 2) * (1 if number % 2 else -1)


def values_of_starts(values: Values, count: int = STARTS) -> list[dict[str, Mapping[str, Any]]]:
    """Parameters by node and dotted name for each start; the first are ``values`` themselves."""
    driver = values.get("driver", {})
    initial = float(driver.get("simulated.initial_y", 0.0))
    return [{**values, "driver": {**driver, "simulated.initial_y": initial + one}} for one in offsets(count)]


def can_run(values: Values) -> bool:
    """Whether the compiled loop models a cycle under ``values``; ParameterError if a parameter is refused."""
    driver, _, controller, _ = node_set(values)
    rate = driver.stage.rate
    oldest_command = (driver.stage.drive.delay + 1.0) / rate
    answers_in_time = oldest_command < driver.simulated.command_timeout
    return rate == controller.stage.rate and answers_in_time and not controller.learning.learn


def run_stroke(values: Values, delays: NDArray[np.int64] | None = None) -> tuple[StrokeRecord, StraightnessMap]:
    """The first cycle under ``values``, for which :func:`can_run` must hold, and the map.

    The result is that of `Simulation`, to the last bit, in a seventh of the time.

    ``delays`` are those of the first commands in ns, in place of ``stage.drive.delay``, which the others have.

    Raises:
        ParameterError, SurveyError: the parameters are refused.
        ValueError: the platform's position, or the current, was not finite.
    """
    scenario, stroke, cycle = compiled_cycle(values, delays)
    (law,), guide = scenario.controls, scenario.driver.guide()
    time = np.arange(stroke.stamps.size) * (scenario.description.period_ns * 1e-9)
    return stroke.record(time, cycle, guide.offset - along(guide, stroke.true_x)[0], law), stroke.map


def compiled_cycle(values: Values, delays: NDArray[np.int64] | None = None) -> tuple[Scenario, Stroke, Cycle]:
    """What :func:`run_stroke` makes its record of; ``delays`` and errors as there."""
    law = node_set(values).controller.control.law
    scenario = make_scenario(values, [law])
    stroke = scenario.stroke()
    cycle = scenario.cycle(laws_of(scenario)[law], stroke, delays)
    if cycle.y.size < stroke.stamps.size:
        raise ValueError(f"law '{law}': position or control current is not finite after {cycle.y.size} samples")
    return scenario, stroke, cycle


def first_cycle(values: Values, law: Law | None = None) -> tuple[StrokeRecord, StraightnessMap]:
    """The first cycle under ``values``, compiled if possible, and the map; ``law`` replaces theirs. Raises the errors
    of :func:`run_stroke`."""
    if law is None and can_run(values):
        return run_stroke(values)
    simulation = Simulation(values, law)
    return simulation.run(), simulation.map


def runs_of_starts(
    values: Values, count: int = STARTS, progress: Callable[[float], None] = lambda fraction: None
) -> Iterator[tuple[StrokeRecord, StraightnessMap]]:
    """:func:`first_cycle` from each start, in the order of :func:`offsets`. ``progress`` is called with the fraction
    that is done. Raises the errors of :func:`run_stroke`."""
    for number, one in enumerate(values_of_starts(values, count), 1):
        yield first_cycle(one)
        progress(number / count)
