"""A frequency response measured: of the simulated stage, whose loop is excited in simulated time, or from a bag."""

import dataclasses
import functools
from array import array
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams, values_at
from straightcomp_ros.contract import COMMAND, CONTROLLER_STATE, DRIVER_STATE, ENCODER
from straightcomp_ros.control.excitation import (
    FrequencyResponseError,
    Multisine,
    MultisineParameters,
    multisine_injection,
)
from straightcomp_ros.control.law import Command
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.hardware.interface import Hardware, Sample, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint, cycles
from straightcomp_ros.offline.scenario import node_set
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.frequency_response import ExcitationEnded
from straightcomp_ros.tuning.frequency_response.measured_response import ComparedResponse, compared_response

_SETTLE = 1.0
"""s before the excitation, in which the law settles."""
_SPARE = 0.5
"""s of rest after the excitation."""
_ALIKE = 0.9
"""Least correlation of what was injected with the excitation, of all of it and in the used period of each draw."""
_IN_TIME = 1.02
"""Of the time at which a command is due, that at which it is in time all the same."""


def measure_simulated(
    values: Values,
    parameters: MultisineParameters,
    *,
    moving: bool = False,
    wiring: Callable[[SimulatedHardware], Hardware] | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> ComparedResponse:
    """Measure the loop of the simulated stage under the parameters of the nodes.

    With ``moving`` the stage makes strokes meanwhile; otherwise it stands in the middle of the stroke. ``wiring`` puts
    something between the machine and its driver.

    Raises:
        FrequencyResponseError: the excitation does not fit the rate.
        ExcitationEnded: the platform left the allowed travel.
        ParameterError, SurveyError: the parameters are refused.
        ValueError: the law has no linearisation at rest.
    """
    nodes = node_set(values)
    stage, control = nodes.controller.stage, nodes.controller.control
    excitation, injection = multisine_injection(parameters, make_law(control, stage), stage)
    duration = excitation.currents.size / stage.rate
    simulation = Simulation(values, motion=(_motion(nodes.cell.stage.motion, duration, moving), 0), wiring=wiring)
    first, rows = round(_SETTLE * stage.rate), array("d")
    index = 0

    def observe(sample: Sample, truth: Truth, reference: Sequence[float], command: Command, age: float) -> None:
        nonlocal index
        index += 1
        if index == first:
            simulation.inject(injection)
        elif index > first:
            asked = command.equivalent_current + command.switching_current
            rows.extend((asked, command.current, sample.y))

    simulation.run(progress, observe)
    if injection.stopped:
        raise ExcitationEnded(
            f"the excitation was ended early: {injection.stopped}; take less current, or allow more travel"
        )
    asked, commands, reading = np.frombuffer(rows).reshape(-1, 3).T
    return compared_response(excitation, asked, commands, reading, control, stage, injection.clipped)


def _motion(motion: MotionParameters, duration: float, moving: bool) -> Trajectory:
    """The stage's motion until the end of an excitation of ``duration`` in s."""
    end_ns = round((_SETTLE + duration + _SPARE) * 1e9)
    if moving:
        return Trajectory(cycles(motion, -(-end_ns // Trajectory(cycles(motion, 1)).end_ns)))
    place = motion.start + 0.5 * motion.stroke
    return Trajectory([Waypoint(0, place, 0.0), Waypoint(end_ns, place, 0.0)])


def response_from_bag(
    bag: Path, parameters: MultisineParameters, control: ControlParameters, stage: StageParameters
) -> ComparedResponse:
    """The response of a loop that the controller's service ``~/excite`` excited.

    Samples are counted as the controller answered them: a lost one shifts the excitation too. The driver's state shows
    which commands came late. ``control`` are law and gains under which the bag was made; the response is compared with
    the description ``stage``.

    Raises:
        FrequencyResponseError: the bag cannot be read.
        ExcitationEnded: it has not the whole excitation.
    """
    wanted = (ENCODER, COMMAND, CONTROLLER_STATE)
    try:
        streams = read_streams(bag, {stream.topic: stream.layout for stream in (*wanted, DRIVER_STATE)})
    except BagError as error:
        raise FrequencyResponseError(str(error)) from error
    missing = [stream.topic for stream in wanted if stream.topic not in streams]
    if missing:
        raise FrequencyResponseError(f"bag {bag}: has no messages on {', '.join(missing)}")
    common = functools.reduce(np.intersect1d, (streams[stream.topic].stamp for stream in wanted))
    state = streams[CONTROLLER_STATE.topic]
    commands = values_at(streams[COMMAND.topic], "control_current", common)
    asked = values_at(state, "equivalent_current", common) + values_at(state, "switching_current", common)
    excitation, injection = multisine_injection(parameters, make_law(control, stage), stage)
    limit = stage.highest_current
    added = np.nan_to_num(commands - np.clip(asked, -limit, limit))
    first, alike = _place(added, excitation.currents)
    part = slice(first, first + excitation.currents.size)
    if alike < _ALIKE or len(commands[part]) < excitation.currents.size:
        raise ExcitationEnded(
            f"bag {bag}: has not the whole excitation (correlation {alike:.2f}; allowed: >= {_ALIKE:g}); was it ended "
            "early, or made with other parameters?"
        )
    # With its fades, of which a short period has much.
    whole = np.array([injection.step(0.0, 0.0) for _ in range(excitation.currents.size)])
    lacking = _missing_draws(excitation, added[part], whole)
    if lacking:
        raise ExcitationEnded(
            f"bag {bag}: the excitation lacks {lacking} of its {excitation.draws} draws of phases; was it ended early?"
        )
    reading = values_at(streams[ENCODER.topic], "y", common)
    clipped = int(np.count_nonzero(np.abs(commands[part]) >= limit))
    found = compared_response(excitation, asked[part], commands[part], reading[part], control, stage, clipped)
    if DRIVER_STATE.topic not in streams:
        return found
    latency = values_at(streams[DRIVER_STATE.topic], "command_latency", common[part])
    # A sample without a latency is one before which no command arrived: it came after it, together with the next one.
    late = ~(latency <= _IN_TIME * stage.drive.delay * stage.period)
    return dataclasses.replace(found, late_share=float(np.mean(late)))


def _missing_draws(excitation: Multisine, added: NDArray[np.float64], wanted: NDArray[np.float64]) -> int:
    """Draws whose used period is not in ``added`` (n,): of most of an excitation the correlation is high too."""
    there, expected = excitation.used(added), excitation.used(wanted)
    power = np.sqrt(np.sum(there**2, axis=1) * np.sum(expected**2, axis=1))
    return int(np.count_nonzero(np.sum(there * expected, axis=1) <= _ALIKE * power))


def _place(series: NDArray[np.float64], wanted: NDArray[np.float64]) -> tuple[int, float]:
    """Where ``wanted`` (m,) begins in ``series`` (n,), and how well it correlates with what is there."""
    size = series.size + wanted.size
    product = np.fft.irfft(np.fft.rfft(series, size) * np.fft.rfft(wanted, size).conj(), size)
    first = int(np.argmax(product[: max(1, series.size)]))
    there = series[first : first + wanted.size]
    power = float(np.sqrt(np.sum(there**2) * np.sum(wanted**2)))
    return first, float(product[first]) / power if power else 0.0
