"""What is told of laws beside each other: the error, how hard they work the coils, what a step costs."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.configuration import ControllerNodeParameters, node_parameters
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.simulation import Simulation

_TIMED_SAMPLES = 2000
_REPEATS = 5

Values = Mapping[str, Mapping[str, Any]]
"""Parameters by node and dotted name, as `read_parameter_file` gives them."""


@dataclass(frozen=True)
class LawFigures:
    """One law over one cycle of the stage, offline.

    Attributes:
        pp, rms: true compensation error, m.
        control_activity: Σ |Δ i_c| over the motion, A.
        control_rms_step: root mean square of Δ i_c from sample to sample, A.
        step_time: of the processor for one sample of the law alone, s; the least of some repetitions.
    """

    pp: float
    rms: float
    control_activity: float
    control_rms_step: float
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


def figures_of(values: Values, law: Law | None = None) -> LawFigures:
    """Run one cycle under ``law``, or under the one that ``values`` name, and time its step on the samples of that run.

    Raises:
        ParameterError, SurveyError: the parameters are refused.
        MetricsError: the stage does not move.
    """
    law = law or law_of(values)
    simulation = Simulation(values, law=law)
    samples: list[tuple[float, ...]] = []
    record = simulation.run(
        observe=lambda sample, truth, reference, command, age: samples.append((sample.y, *reference, sample.current))
    )
    metrics = evaluate(record, simulation.map)
    assert metrics.true_pp is not None and metrics.true_rms is not None  # a simulation knows the truth
    middle = samples[len(samples) // 4 :][:_TIMED_SAMPLES]
    return LawFigures(
        metrics.true_pp, metrics.true_rms, metrics.control_activity, metrics.control_rms_step, step_time(law, middle)
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
