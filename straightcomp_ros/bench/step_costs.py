"""Measures the functions that are called once in each cycle: laws, messages, and a cycle of the simulation."""

import statistics
import timeit
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from straightcomp_ros.contract import STREAMS
from straightcomp_ros.control.laws import LAWS, ControlParameters, make_law
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.stage.description import StageParameters

_CALLS = 1000


Cost = dict[str, float]
"""Time of one call in µs: ``median_us`` over repeats of many calls, ``min_us`` and ``max_us``."""


def _cost(times: Sequence[float]) -> Cost:
    return {"median_us": statistics.median(times), "min_us": min(times), "max_us": max(times)}


def cost(work: Callable[[], object], calls: int, repeats: int) -> Cost:
    """Time ``work``, which makes ``calls`` calls, ``repeats`` times after one call to warm up."""
    work()
    return _cost([seconds * 1e6 / calls for seconds in timeit.repeat(work, number=1, repeat=repeats)])


def law_costs(parameters: ControlParameters, stage: StageParameters, repeats: int) -> dict[str, Cost]:
    """One step of each law, with the platform's error swinging by half a micrometre about the reference."""
    # Both signs of the error, and amplitudes inside and outside the boundary layer.
    readings = [0.5e-6 * (-1) ** k * (k % 10) / 10 for k in range(_CALLS)]

    def work(law: Any) -> None:
        step = law.step
        law.reset(0.0)
        for y in readings:
            step(y, 1e-6, 1e-5, 1e-4, 0.1)

    laws = {name: make_law(replace(parameters, law=name), stage) for name in LAWS}
    return {name: cost(partial(work, law), _CALLS, repeats) for name, law in laws.items()}


def message_costs(repeats: int) -> dict[str, dict[str, Cost]]:
    """Serialising (``pack``) and reading (``unpack``) one message of each stream, by topic."""
    return {stream.topic: _message_costs(stream.layout, repeats) for stream in STREAMS}


def _message_costs(layout: Any, repeats: int) -> dict[str, Cost]:
    numbers = [0.1 * k for k in range(len(layout.columns))]
    data = layout.pack(1_700_000_000_123_456_789, *numbers)

    def pack() -> None:
        packed = layout.pack
        for stamp_ns in range(_CALLS):
            packed(stamp_ns, *numbers)

    def unpack() -> None:
        unpacked = layout.unpack
        for _ in range(_CALLS):
            unpacked(data)

    return {"pack": cost(pack, _CALLS, repeats), "unpack": cost(unpack, _CALLS, repeats)}


def simulation_cost(values: Mapping[str, Mapping[str, Any]], repeats: int) -> tuple[Cost, float]:
    """Cost of one sample of `straightcomp simulate`, and how many seconds it simulates in one. ParameterError or
    SurveyError if a parameter or the map is refused."""
    rate = node_parameters("driver", values).stage.rate
    # Exclude what is made once, before the first sample.
    simulations = [Simulation(values) for _ in range(repeats + 1)]
    samples = len(simulations.pop().run().time)
    found = _cost([timeit.timeit(one.run, number=1) * 1e6 / samples for one in simulations])
    return found, 1e6 / (found["median_us"] * rate)
