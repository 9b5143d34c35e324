"""A frequency response of the simulated stage: the loop of the nodes in simulated time, excited."""

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.configuration.node_parameters import Values
from straightcomp_ros.control.injection import Injection
from straightcomp_ros.control.law import Command
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.frequency_response import FrequencyResponseError
from straightcomp_ros.frequency_response.closed_form import LoopResponse, friction_damping, loop_response
from straightcomp_ros.frequency_response.measured_response import MeasuredResponse, measured_response
from straightcomp_ros.frequency_response.multisine import MultisineParameters, multisine
from straightcomp_ros.hardware.interface import Hardware, Sample, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint, cycles
from straightcomp_ros.offline.simulation import Simulation, node_set

WITHIN_DB, WITHIN_DEG = 1.0, 5.0
"""Deviations up to which a model explains a measurement."""
_SETTLE = 1.0
"""s before the excitation, in which the law settles."""
_FADE = 0.25
"""s over which the excitation rises and falls."""
_SPARE = 0.5
"""s of rest after the excitation."""


@dataclass(frozen=True, eq=False)
class ComparedResponse:
    """A measured response beside that of the description.

    Attributes:
        law: name of the law.
        measured: the measurement.
        model: closed form of the description, at the measured lines, with friction linearised at the measured speed.
        damping: that friction, N·s/m.
        clipped: samples in which the current limit cut the excitation.
        duration: of the excitation, s.
    """

    law: str
    measured: MeasuredResponse
    model: LoopResponse
    damping: float
    clipped: int
    duration: float

    @property
    def deviations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(lines,) each: the measured plant relative to the model's, magnitude in dB and phase in degrees."""
        ratio = self.measured.response.plant / self.model.plant
        return 20.0 * np.log10(np.abs(ratio)), np.degrees(np.angle(ratio))

    @property
    def explained(self) -> bool:
        """Whether there are coherent lines, and none contradicts the description.

        A line contradicts it if it is certainly off by more than `WITHIN_DB` or `WITHIN_DEG`: if no value in its circle
        is nearer. The circles are those that hold for all coherent lines at once.
        """
        measured = self.measured
        size = np.abs(measured.response.plant)
        radius = np.minimum(1.0, measured.jointly * measured.plant_radius / size)
        gain, phase = self.deviations
        with np.errstate(divide="ignore"):
            least, most = gain + 20.0 * np.log10(1.0 - radius), gain + 20.0 * np.log10(1.0 + radius)
        turned = np.abs(phase) - np.degrees(np.arcsin(radius))
        off = (least > WITHIN_DB) | (most < -WITHIN_DB) | (turned > WITHIN_DEG)
        return bool(measured.coherent.any() and not (measured.coherent & off).any())


def measure_simulated(
    values: Values,
    parameters: MultisineParameters,
    *,
    moving: bool = False,
    wiring: Callable[[SimulatedHardware], Hardware] | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> ComparedResponse:
    """Measure the loop of the simulated stage under the parameters of the nodes.

    Args:
        values: parameters by node and dotted name.
        parameters: of the excitation.
        moving: the stage makes strokes meanwhile; otherwise it stands in the middle of the stroke.
        wiring: puts something between the machine and its driver.
        progress: called with the fraction that is done.

    Raises:
        FrequencyResponseError: the excitation does not fit the rate, or the platform left the allowed travel.
        ParameterError, SurveyError: the parameters are refused.
        ValueError: the law has no linearisation at rest.
    """
    nodes = node_set(values)
    stage, control = nodes.controller.stage, nodes.controller.control
    law, limit = make_law(control, stage), min(stage.actuator.current_limit, stage.drive.largest_current)

    def expected(frequencies: NDArray[np.float64]) -> LoopResponse:
        return loop_response(law, stage, frequencies, stage.friction.viscous)

    excitation = multisine(parameters, stage.rate, expected)
    injection = Injection(
        excitation.currents, fade=max(1, round(_FADE * stage.rate)), limit=limit, travel=parameters.travel
    )
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
            rows.extend((command.current - max(-limit, min(limit, asked)), command.current, sample.y))

    simulation.run(progress, observe)
    if injection.stopped:
        raise FrequencyResponseError(
            f"the excitation was ended early: {injection.stopped}; take less current, or allow more travel"
        )
    signal, command, reading = np.frombuffer(rows).reshape(-1, 3).T
    measured = measured_response(excitation, signal, command, reading)
    damping = friction_damping(stage.friction, measured.speed)
    model = loop_response(law, stage, measured.frequencies, damping)
    return ComparedResponse(control.law, measured, model, damping, injection.clipped, duration)


def _motion(motion: MotionParameters, duration: float, moving: bool) -> Trajectory:
    """The stage's motion until the end of an excitation of ``duration`` in s."""
    end_ns = round((_SETTLE + duration + _SPARE) * 1e9)
    if moving:
        return Trajectory(cycles(motion, -(-end_ns // Trajectory(cycles(motion, 1)).end_ns)))
    place = motion.start + 0.5 * motion.stroke
    return Trajectory([Waypoint(0, place, 0.0), Waypoint(end_ns, place, 0.0)])
