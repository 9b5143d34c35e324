"""Figures for a comparison of laws: the error, the changes of the coils' current, the processor time of a step."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.offline.scenario import node_set
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import STARTS, Spread, first_cycle, spread, values_of_starts
from straightcomp_ros.parameters.node_parameters import Values

_TIMED_SAMPLES = 2000
_REPEATS = 5


@dataclass(frozen=True)
class LawFigures:
    """One law over one cycle of the stage, offline, from several starts.

    Attributes:
        pp, rms: true compensation error, m.
        control_activity: Σ |Δ i_c| over the motion, A.
        control_rms_step: root mean square of Δ i_c from sample to sample, A.
        step_time: processor time of one step of the law alone, s; the least of several repetitions.
    """

    pp: Spread
    rms: Spread
    control_activity: Spread
    control_rms_step: Spread
    step_time: float


def law_of(values: Values) -> Law:
    """The law that the controller of ``values`` runs; ParameterError if a parameter is refused."""
    controller = node_set(values).controller
    return make_law(controller.control, controller.stage)


def figures_of(values: Values, law: Law | None = None, starts: int = STARTS) -> LawFigures:
    """Run one cycle from each of ``starts`` starts, and time the law's step on the samples of the first.

    Args:
        values: parameters by node and dotted name.
        law: replaces the law that ``values`` name; it need not be compilable.
        starts: number of starts.

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
    found = [evaluate(record, simulation.map), *(evaluate(*first_cycle(other, law)) for other in others)]
    return LawFigures(
        # A simulation knows the truth.
        spread(metrics.true_pp or math.nan for metrics in found),
        spread(metrics.true_rms or math.nan for metrics in found),
        spread(metrics.control_activity for metrics in found),
        spread(metrics.control_rms_step for metrics in found),
        _step_time(timed, samples[len(samples) // 4 :][:_TIMED_SAMPLES]),
    )


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
