"""The simulated machine: plant, encoders, D/A, amplifier and stage behind the hardware interface.

It models a board with its own sampling clock. Samples lie on an exact grid, whenever the host fetches them. A command
takes effect ``stage.drive.delay`` after the sample that it answers, or on arrival if that is later. (If commands
acted on arrival, the loop's delay would be as irregular as the host.)

When the next command is late, the board holds the platform by itself (:mod:`straightcomp_ros.model.plant`)
until a command comes or ``command_timeout`` switches the amplifier off.
"""

import math
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np

from straightcomp_ros.hardware.interface import Hardware, HardwareError, Sample, State, Truth
from straightcomp_ros.model.motion import Trajectory, Waypoint, trapezoid
from straightcomp_ros.model.paced_motion import Pace, PacedMotion
from straightcomp_ros.model.plant import BIAS, COMMAND, Hold, advance_to_sample, commanded_plant, plant_state
from straightcomp_ros.parameters.declaration import group, parameter
from straightcomp_ros.safety.faults import Fault, Finding
from straightcomp_ros.stage.description import StageParameters, TruthParameters, true_plant
from straightcomp_ros.straightness.feedforward import follower
from straightcomp_ros.straightness.guide_map import StraightnessMap, load_map
from straightcomp_ros.straightness.survey_header import SurveyError

_AT_INDEX_NS = 10_000_000
_INDEX_M = 1e-9
"""So near a stage that rests at the index is to it, but for rounding."""
_HOMING = "it is being homed"
_HOMING_ENDED = "homing ended before the index; call home again"


@dataclass(frozen=True)
class SimulatedParameters:
    """The simulated machine."""

    command_timeout: float = parameter(0.005, "Age of the newest command at which the board switches off", "(0, 1] s")
    hold_after: float = parameter(
        1.25,
        "Time after the last command took effect at which the board begins to hold the platform by itself",
        "[1.1, 1e6] samples",
    )
    hold_mean: float = parameter(0.015, "Time constant of the mean command, held when commands stop", "(0, 10] s")
    hold_braking: float = parameter(
        0.5, "While holding: share of the last commands' impulse taken back per sample", "[0, 1]"
    )
    hold_memory: float = parameter(0.001, "Time constant with which friction ends an impulse", "(0, 1] s")
    hold_stiffness: float = parameter(
        10.5, "Stiffness of the board's hold, relative to the negative stiffness of the magnets", "[0, 1000]"
    )
    sample_memory: float = parameter(0.128, "Time for which the board keeps samples for a late host", "(0, 60] s")
    referenced: bool = parameter(
        True, "x is counted from its reference when the machine is switched on; otherwise from where the stage stands"
    )
    index: float = parameter(0.0, "Position of the index mark from which x is counted after homing", "[-100, 100] m")
    index_shift: float = parameter(0.0, "Shift of that mark since the machine was described", "[-1, 1] m")
    initial_y: float = parameter(0.0, "Platform's position at the start", "[-0.01, 0.01] m")
    truth: TruthParameters = group(TruthParameters, "Simulated machine")

    def hold(self, stage: StageParameters) -> Hold:
        """The parameters ``hold_…`` on a stage."""
        return Hold(
            after_ns=round(self.hold_after * 1e9 / stage.rate),
            weight=1.0 - math.exp(-1.0 / (stage.rate * self.hold_mean)),
            kept=math.exp(-1.0 / (stage.rate * self.hold_memory)),
            braking=self.hold_braking,
            stiffness=self.hold_stiffness * stage.actuator.bias_current / stage.actuator.air_gap,
        )


def switched_on_at(stage: StageParameters, guide: StraightnessMap) -> float:
    """Where a simulated stage stands when it is switched on, m: at zero, or where its strokes start if zero is not on
    the map and the true guide, with their run-out."""
    spans, runout = [guide.span], stage.guide.runout
    with suppress(SurveyError):  # a machine with a true guide of its own needs no map
        spans.append(load_map(stage.guide).span)
    return 0.0 if all(first - runout <= 0.0 <= last + runout for first, last in spans) else stage.motion.start


class SimulatedHardware(Hardware):
    """Plant and stage in simulated time, integrated up to the caller's time.

    Args:
        parameters: of the board, and how the machine differs from its description.
        stage: the description.
        guide: the true deviation δ(x).
        x: where the stage stands at the start by its reference, m; by default :func:`switched_on_at`.

    Raises:
        ParameterError: the true air gap does not hold the mechanical stop.
    """

    state = State.OFF
    fault: Finding | None = None
    lost_samples = 0
    unreferenced = ""

    def __init__(
        self, parameters: SimulatedParameters, stage: StageParameters, guide: StraightnessMap, x: float | None = None
    ) -> None:
        zero = parameters.index_shift if parameters.referenced else 0.0
        x = switched_on_at(stage, guide) if x is None else x + zero
        plant = true_plant(stage, parameters.truth)
        self.period_ns = stage.period_ns
        self.command_timeout_ns = round(parameters.command_timeout * 1e9)
        self._parameters = parameters
        self._guide, self._guide_offset = follower(guide), guide.offset
        self._bias = plant.actuator.bias_current
        self._plant = commanded_plant(plant, parameters.hold(stage), plant_state(y=parameters.initial_y))
        self._effective_ns, self._asked = np.empty(16, np.int64), np.empty(16)
        self._waiting = 0
        """Commands at the beginning of these two arrays that are yet to take effect."""
        self._advance: Callable[..., int] = partial(advance_to_sample.dispatcher, *self._plant)  # type: ignore[attr-defined]
        # The first call compiles, which must not happen inside the loop; at time 0 it changes nothing.
        self._advance(self._effective_ns, self._asked, 0, 0, 0.0, x)
        self._reading = plant.encoder.x_reading
        self._motion, self._index = stage.motion, parameters.index + parameters.index_shift
        self.zero = zero if parameters.referenced else x
        if not parameters.referenced:
            self.unreferenced = "the machine has not been homed since it was switched on"
        self._delay_ns = round(stage.drive.delay * self.period_ns)
        self._time_ns = self._next_sample_ns = self._last_command_ns = 0
        self.motion = PacedMotion(stage.motion, x, plant.encoder.x_resolution)
        self._memory = max(1, round(parameters.sample_memory * stage.rate))

    def start(self, now_ns: int) -> None:
        self._time_ns = self._next_sample_ns = self._last_command_ns = now_ns
        self._plant.set_time(now_ns)

    def read(self, now_ns: int) -> list[tuple[Sample, Truth]]:
        # A process that was suspended may be late by millions of samples.
        samples: deque[tuple[Sample, Truth]] = deque(maxlen=self._memory)
        first_ns = self._next_sample_ns
        while self._next_sample_ns <= now_ns:
            samples.append(self._sample(self._next_sample_ns))
            self._next_sample_ns += self.period_ns
        self.lost_samples += (self._next_sample_ns - first_ns) // self.period_ns - len(samples)
        return list(samples)

    def write(self, current: float, at_ns: int, sample_ns: int | None = None) -> None:
        if not math.isfinite(current):
            raise ValueError(f"control current {current} A is not finite")
        if sample_ns is not None:
            # No sample is newer than the last one, whatever a command says: it would keep all others waiting.
            newest_ns = self._next_sample_ns - self.period_ns
            at_ns = max(at_ns, min(sample_ns, newest_ns) + self._delay_ns)
        effective_ns, count = max(at_ns, self._time_ns), self._waiting
        if count:
            effective_ns = max(effective_ns, int(self._effective_ns[count - 1]))
        if count == self._asked.size:
            self._effective_ns = np.resize(self._effective_ns, 2 * count)
            self._asked = np.resize(self._asked, 2 * count)
        self._effective_ns[count], self._asked[count] = effective_ns, current
        self._waiting, self._last_command_ns = count + 1, effective_ns

    def enable(self) -> None:
        if self.fault:
            raise HardwareError(f"a fault is latched: {self.fault[1]}")
        if self.state is State.OFF:
            self.state = State.ON
            self._plant.state[BIAS] = self._bias
            self._last_command_ns = max(self._last_command_ns, self._time_ns)

    def disable(self) -> None:
        self._currents_off()
        if self.state is State.ON:
            self.state = State.OFF

    def reset_fault(self) -> None:
        if self.fault:
            self.state, self.fault = State.OFF, None

    def move(self, trajectory: Trajectory, start_ns: int) -> None:
        if self.motion.moving:
            # A sample that is due, but not taken yet, is of the motion that there was.
            start_ns = min(start_ns, self._next_sample_ns)
        self.motion.begin(trajectory.shifted(self.zero), start_ns)
        if self.unreferenced == _HOMING:
            self.unreferenced = _HOMING_ENDED

    def home(self, now_ns: int) -> None:
        if self.state is State.ON:
            raise HardwareError("x cannot be referenced with the amplifier on")
        motion, shift = self._motion, self._parameters.index_shift
        points = [Waypoint(0, self.motion.position(now_ns), 0.0)]
        points += trapezoid(points[-1], self._index, motion.speed, motion.acceleration)
        # The index is found at rest.
        points.append(Waypoint(points[-1].time_ns + _AT_INDEX_NS, self._index, 0.0))
        points += trapezoid(points[-1], motion.start + shift, motion.speed, motion.acceleration)
        self.motion.begin(Trajectory(points), now_ns)
        self.unreferenced = _HOMING

    def pace(self, pace: Pace) -> None:
        self.motion.ask(pace)

    @property
    def applied_current(self) -> float:
        return float(self._plant.state[COMMAND])

    def _currents_off(self) -> None:
        self._waiting = 0
        self._plant.currents_off()

    def _sample(self, time_ns: int) -> tuple[Sample, Truth]:
        count, x = self._waiting, self.motion.position(time_ns)
        taken = self._advance(self._effective_ns, self._asked, count, time_ns, 0.0, x)
        if taken:
            self._waiting = left = count - taken
            if left:
                self._effective_ns[:left] = self._effective_ns[taken:count]
                self._asked[:left] = self._asked[taken:count]
        if self.unreferenced == _HOMING:
            if abs(x - self._index) <= _INDEX_M:
                self.zero, self.unreferenced = self._parameters.index_shift, ""
            elif self.motion.over:
                self.unreferenced = _HOMING_ENDED
        self._time_ns = time_ns
        age_ns = time_ns - self._last_command_ns
        if age_ns > self.command_timeout_ns and self.state is State.ON:
            self.state = State.FAULT
            limit_ms = self.command_timeout_ns * 1e-6
            reason = f"no command for {age_ns * 1e-6:.1f} ms (command_timeout {limit_ms:g} ms)"
            self.fault = Fault.COMMAND_TIMEOUT, reason
            self._currents_off()
        _, _, _, control, _, friction, magnetic, *_, velocity, y, reading = self._plant.state.tolist()
        measured = control if self.state is State.ON else math.nan
        truth = Truth(x, y, velocity, friction, magnetic, self._guide_offset - self._guide(x)[0])
        return Sample(time_ns, self._reading(x - self.zero), reading, measured), truth
