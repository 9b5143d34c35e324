"""A frequency response of the simulated stage: the loop of the nodes in simulated time, excited."""

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.closed_form import LoopResponse, friction_damping, loop_response
from straightcomp_ros.control.excitation_parameters import MultisineParameters
from straightcomp_ros.control.law import Command
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.loop_excitation import loop_multisine, multisine_injection
from straightcomp_ros.control.multisine import Multisine
from straightcomp_ros.hardware.interface import Hardware, Sample, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint, cycles
from straightcomp_ros.offline.scenario import node_set
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.frequency_response import ExcitationEnded
from straightcomp_ros.tuning.frequency_response.measured_response import MeasuredResponse, measured_response

WITHIN_DB, WITHIN_DEG = 1.0, 5.0
"""Deviations up to which a model explains a measurement."""
_FEW_LATE = 0.02
"""Share of late commands that hardly delays a loop: by as much of a sample."""
_SETTLE = 1.0
"""s before the excitation, in which the law settles."""
_SPARE = 0.5
"""s of rest after the excitation."""


@dataclass(frozen=True, eq=False)
class ComparedResponse:
    """A measured response beside that of the description.

    Attributes:
        law: name of the law.
        measured: the measurement.
        model: of the description, at the measured lines: its closed form with friction linearised at the measured
            speed, unless something else is put in its place.
        damping: that friction, N·s/m.
        clipped: samples in which the current limit cut the excitation.
        duration: of the excitation, s.
        late_share: of the samples, those whose command arrived after it was due, or not before the next sample's.
    """

    law: str
    measured: MeasuredResponse
    model: LoopResponse
    damping: float
    clipped: int
    duration: float
    late_share: float = 0.0

    @property
    def lateness(self) -> str:
        """What the host did to the measurement, in a sentence; empty if it served the loop well enough."""
        if self.late_share <= _FEW_LATE:
            return ""
        return (
            f"{self.late_share:.0%} of the commands came late, which delays the loop on the mean and is no fault of "
            "the machine; straightcomp doctor says what delays this computer"
        )

    @property
    def deviations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(lines,) each: the measured plant relative to the model's, magnitude in dB and phase in degrees."""
        ratio = self.measured.response.plant / self.model.plant
        return 20.0 * np.log10(np.abs(ratio)), np.degrees(np.angle(ratio))

    @property
    def explained(self) -> bool:
        """Whether there are coherent lines, all are finite, and none contradicts the description.

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
        # Written so that NaN is off.
        off = ~((least <= WITHIN_DB) & (most >= -WITHIN_DB) & (turned <= WITHIN_DEG))
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
        FrequencyResponseError: the excitation does not fit the rate.
        ExcitationEnded: the platform left the allowed travel.
        ParameterError, SurveyError: the parameters are refused.
        ValueError: the law has no linearisation at rest.
    """
    nodes = node_set(values)
    stage, control = nodes.controller.stage, nodes.controller.control
    excitation = loop_multisine(parameters, make_law(control, stage), stage)
    injection = multisine_injection(parameters, excitation, stage)
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


def compared_response(
    excitation: Multisine,
    asked: NDArray[np.float64],
    commands: NDArray[np.float64],
    reading: NDArray[np.float64],
    control: ControlParameters,
    stage: StageParameters,
    clipped: int,
) -> ComparedResponse:
    """The response from series (n,) that begin with the excitation, beside that of a description.

    Args:
        excitation: what was injected.
        asked: the law's current without the excitation, before the limit, A.
        commands: with it, A.
        reading: y, m.
        control: the law and its gains.
        stage: the description.
        clipped: samples in which the limit cut the excitation.
    """
    limit = stage.highest_current
    signal = commands - np.clip(asked, -limit, limit)
    measured = measured_response(excitation, signal, commands, reading)
    damping = friction_damping(stage.friction, measured.speed)
    model = loop_response(make_law(control, stage), stage, measured.frequencies, damping)
    duration = excitation.currents.size / stage.rate
    return ComparedResponse(control.law, measured, model, damping, clipped, duration)


def _motion(motion: MotionParameters, duration: float, moving: bool) -> Trajectory:
    """The stage's motion until the end of an excitation of ``duration`` in s."""
    end_ns = round((_SETTLE + duration + _SPARE) * 1e9)
    if moving:
        return Trajectory(cycles(motion, -(-end_ns // Trajectory(cycles(motion, 1)).end_ns)))
    place = motion.start + 0.5 * motion.stroke
    return Trajectory([Waypoint(0, place, 0.0), Waypoint(end_ns, place, 0.0)])
