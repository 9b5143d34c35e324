"""What is told of laws beside each other: the error, how hard they work the coils, what a step costs."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.configuration.node_parameters import ControllerNodeParameters, node_parameters
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.sweep.starts import STARTS, Spread, first_cycle, spread, values_of_starts

_TIMED_SAMPLES = 2000
_REPEATS = 5

Values = Mapping[str, Mapping[str, Any]]
"""Parameters by node and dotted name, as `read_parameter_file` gives them."""


@dataclass(frozen=True)
class LawFigures:
    """One law over one cycle of the stage, offline, from several starts.

    Attributes:
        pp, rms: true compensation error, m.
        control_activity: Σ |Δ i_c| over the motion, A.
        control_rms_step: root mean square of Δ i_c from sample to sample, A.
        step_time: of the processor for one sample of the law alone, s; the least of some repetitions.
    """

    pp: Spread
    rms: Spread
    control_activity: Spread
    control_rms_step: Spread
    step_time: float


def with_values(values: Values, node: str, changes: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """``values`` with other ones for some parameters of ``node``, by dotted name."""
    copied = {name: dict(parameters) for name, parameters in values.items()}
    copied.setdefault(node, {}).update(changes)
    return copied


def law_of(values: Values) -> Law:
    """The law that the controller of ``values`` runs.

    Raises:
        ParameterError: a parameter is refused.
    """
    controller: ControllerNodeParameters = node_parameters("controller", values.get("controller", {}))
    return make_law(controller.control, 1.0 / controller.rate)


def figures_of(values: Values, law: Law | None = None, starts: int = STARTS) -> LawFigures:
    """Run one cycle from each start, and time the law's step on the samples of the first.

    Args:
        values: parameters by node and dotted name.
        law: steps in place of the law that ``values`` name; it need not be compilable.
        starts: how many.

    Raises:
        ParameterError, SurveyError: the parameters are refused.
        MetricsError: the stage does not move.
    """
    timed = law or law_of(values)
    samples: list[tuple[float, ...]] = []
    first, *others = values_of_starts(values, starts)
    simulation = Simulation(first, law=timed)
    record = simulation.run(
        observe=lambda sample, truth, reference, command, age: samples.append((sample.y, *reference, sample.current))
    )
    found = [evaluate(record, simulation.map)]
    for other in others:
        if law is None:
            found.append(evaluate(*first_cycle(other)))
        else:
            simulation = Simulation(other, law=law)
            found.append(evaluate(simulation.run(), simulation.map))
    middle = samples[len(samples) // 4 :][:_TIMED_SAMPLES]
    return LawFigures(
        # A simulation knows the truth.
        spread(metrics.true_pp or math.nan for metrics in found),
        spread(metrics.true_rms or math.nan for metrics in found),
        spread(metrics.control_activity for metrics in found),
        spread(metrics.control_rms_step for metrics in found),
        step_time(timed, middle),
    )


def step_time(law: Law, samples: Sequence[tuple[float, ...]]) -> float:
    """Processor time in s for one step of ``law``, from a run over ``samples``: arguments of `Law.step`, one by one."""
    return min(_run_time(law, samples) for _ in range(_REPEATS)) / len(samples)


def _run_time(law: Law, samples: Sequence[tuple[float, ...]]) -> float:
    law.reset(samples[0][0])
    step = law.step
    started = time.process_time()
    for sample in samples:
        step(*sample)
    return time.process_time() - started
