"""Figures for a comparison of laws: the error, the changes of the coils' current, the processor time of a step."""

import time
from collections.abc import Sequence
from typing import Any

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.offline.scenario import node_set
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import STARTS, first_cycle, spreads, values_of_starts
from straightcomp_ros.parameters.node_parameters import Values

_TIMED_SAMPLES = 2000
_REPEATS = 5
_FIGURES = {
    "pp_um": ("true_pp_um", 1.0),
    "rms_um": ("true_rms_um", 1.0),
    "control_rms_step_mA": ("control_rms_step_A", 1e3),
    "control_activity_A": ("control_activity_A", 1.0),
}
"""By name the figure of `Metrics.to_display`, and its factor."""


def law_of(values: Values) -> Law:
    """The law that the controller of ``values`` runs; ParameterError if a parameter is refused."""
    controller = node_set(values).controller
    return make_law(controller.control, controller.stage)


def figures_of(values: Values, law: Law | None = None, starts: int = STARTS) -> dict[str, Any]:
    """Run one cycle from each of ``starts`` starts, and time the law's step on the samples of the first.

    Args:
        values: parameters by node and dotted name.
        law: replaces the law that ``values`` name; it need not be compilable.
        starts: number of starts.

    Returns:
        By name the median, least and largest of the true error, the RMS change of i_c from sample to sample, and
        Σ |Δ i_c| over the motion; and ``step_us``, the least processor time of several repetitions for one step.

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
    found = spreads(
        evaluate(*one).to_display() for one in ((record, simulation.map), *(first_cycle(one, law) for one in others))
    )
    return {
        **{name: found[figure].scaled(factor)._asdict() for name, (figure, factor) in _FIGURES.items()},
        "step_us": _step_time(timed, samples[len(samples) // 4 :][:_TIMED_SAMPLES]) * 1e6,
    }


def _step_time(law: Law, samples: Sequence[tuple[float, ...]]) -> float:
    """Processor time in s for one step of ``law``, from repeated runs over ``samples``, arguments of `Law.step`."""
    times = []
    for _ in range(_REPEATS):
        law.reset(samples[0][0])
        step = law.step
        started = time.process_time()
        for sample in samples:
            step(*sample)
        times.append(time.process_time() - started)
    return min(times) / len(samples)
