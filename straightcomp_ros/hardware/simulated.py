"""The simulated machine: plant, encoders, D/A, amplifier and stage behind the hardware interface.

It stands for a board with a sampling clock of its own: samples lie on an exact grid of the sampling
period, whenever the host comes to fetch them, and the command that answers one takes effect at a fixed time after it,
``actuation_delay``, or when it arrives, if that is later. (Commands that act as they come in make the loop's delay as
irregular as the host: a law answers one count of the encoder with some 15 mA for one period, and a few commands in a
thousand that come 0.3 ms later than the others double its error peak to peak.)

When the next command is late, the board keeps the platform where it is, until it comes or ``command_timeout`` ends the
waiting: it goes back to the mean of the commands before, which holds against the magnets' pull at that place, takes
back what the last commands gave beyond that mean (each answers an error of its own moment, and is undone by those that
are to follow), and adds a stiffness about the last reading, since the magnets' own is negative.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from straightcomp_ros.contract import DEFAULT_RATE
from straightcomp_ros.hardware.interface import Hardware, HardwareError, Sample, State, Truth
from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.model.plant import PlantParameters, PlantState, advance, as_array
from straightcomp_ros.model.stage import Trajectory, Waypoint
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.settings.declaration import group, parameter
from straightcomp_ros.straightness.guide_map import StraightnessMap

NEVER = 2**62
"""Later than any time in ns, and small enough for compiled code."""


class Hold(NamedTuple):
    """How the board holds the platform when commands are late.

    Attributes:
        after_ns: time since a command took effect from which it does.
        weight: share of each command in the mean.
        kept: share of an impulse that friction leaves after a sample.
        braking: share of what is left that the board takes back in a sample.
        stiffness: control current per displacement, A/m.
    """

    after_ns: int
    weight: float
    kept: float
    braking: float
    stiffness: float


@compilable
def impulse_after(hold: Hold, impulse: float, excess: float) -> float:
    """Impulse on the platform after a sample with the current ``excess`` (A) beyond the mean, in A · samples."""
    return hold.kept * (impulse + excess)


@compilable
def holding_current(hold: Hold, mean: float, impulse: float, displacement: float) -> float:
    """Control current in A that the board applies while it holds the platform, which is ``displacement`` (m) away from
    the place where it is held."""
    return mean - hold.braking * impulse - hold.stiffness * displacement


@dataclass(frozen=True)
class SimulatedParameters:
    """The simulated machine."""

    rate: int = parameter(DEFAULT_RATE, "Samples per second", unit="Hz", minimum=10, maximum=20_000)
    command_timeout: float = parameter(
        0.005, "Age of the newest command at which the board switches off", unit="s", above=0.0, maximum=1.0
    )
    actuation_delay: float = parameter(
        1.0,
        "A command takes effect this long after its sample, or on arrival if that is later, so that the host's jitter"
        " does not change the loop's delay. 0: always on arrival. Lockstep uses lockstep_delay instead",
        unit="samples",
        minimum=0.0,
        maximum=1.0,
    )
    hold_after: float = parameter(
        1.25,
        "Time after the last command took effect at which the board begins to hold the platform by itself",
        unit="samples",
        minimum=1.1,
        maximum=1e6,
    )
    hold_mean: float = parameter(
        0.015, "Time constant of the mean command, held when commands stop", unit="s", above=0.0, maximum=10.0
    )
    hold_braking: float = parameter(
        0.5, "While holding: share of the last commands' impulse taken back per sample", minimum=0.0, maximum=1.0
    )
    hold_memory: float = parameter(
        0.001, "Time constant with which friction ends an impulse", unit="s", above=0.0, maximum=1.0
    )
    hold_stiffness: float = parameter(
        7000.0,
        "Stiffness of the board's hold, as control current per displacement; the magnets' negative stiffness is"
        " I0/y0 = 667 A/m",
        unit="A/m",
        minimum=0.0,
        maximum=1e6,
    )
    sample_memory: int = parameter(256, "Samples that the board keeps for a late host", minimum=1, maximum=100_000)
    initial_y: float = parameter(0.0, "Platform's position at the start", unit="m", minimum=-1e-2, maximum=1e-2)
    plant: PlantParameters = group(PlantParameters, "Simulated plant")

    @property
    def hold(self) -> Hold:
        """The parameters ``hold_…`` at this rate."""
        return Hold(
            after_ns=round(self.hold_after * 1e9 / self.rate),
            weight=1.0 - math.exp(-1.0 / (self.rate * self.hold_mean)),
            kept=math.exp(-1.0 / (self.rate * self.hold_memory)),
            braking=self.hold_braking,
            stiffness=self.hold_stiffness,
        )


class SimulatedHardware(Hardware):
    """Plant and stage in simulated time, integrated up to whatever time the caller names.

    Args:
        parameters: the machine.
        guide: true deviation of the guide δ(x).
    """

    def __init__(self, parameters: SimulatedParameters, guide: StraightnessMap) -> None:
        self.period_ns = round(1e9 / parameters.rate)
        self._parameters = parameters
        self._guide = guide
        self._constants = as_array(parameters.plant.constants())
        self._plant_state = np.array(PlantState(y=parameters.initial_y))
        # The first call compiles; it must not happen inside the loop.
        advance(self._constants, self._plant_state.copy(), 0.0, 0.0, 1, 0.0, 0)
        self.command_timeout_ns = round(parameters.command_timeout * 1e9)
        self._reading = parameters.plant.encoder.reading
        self._converted = parameters.plant.drive.converted
        self._commands: deque[tuple[int, float]] = deque()
        self._command = self._mean_command = self._impulse = 0.0
        self._hold = parameters.hold
        self._actuation_delay_ns = round(parameters.actuation_delay * self.period_ns)
        self._hold_ns = NEVER
        self._holding = False
        self._y = self._anchor = self._reading(parameters.initial_y)
        self._bias = 0.0
        self._time_ns = 0
        self._next_sample_ns = 0
        self._last_command_ns = 0
        self._trajectory = Trajectory([Waypoint(0, 0.0, 0.0)])
        self._trajectory_start_ns = 0
        self._state = State.OFF
        self._fault = ""
        self._lost = 0

    def start(self, now_ns: int) -> None:
        self._time_ns = self._next_sample_ns = self._last_command_ns = now_ns

    def read(self, now_ns: int) -> list[tuple[Sample, Truth]]:
        samples = []
        while self._next_sample_ns <= now_ns:
            self._integrate(self._next_sample_ns)
            if self._time_ns - self._last_command_ns > self.command_timeout_ns:
                self._miss_command()
            samples.append(self._sample())
            self._next_sample_ns += self.period_ns
        surplus = len(samples) - self._parameters.sample_memory
        if surplus > 0:
            self._lost += surplus
            del samples[:surplus]
        return samples

    def write(self, current: float, at_ns: int, sample_ns: int | None = None) -> None:
        if not math.isfinite(current):
            raise ValueError(f"control current {current} A is not finite")
        if sample_ns is not None:
            # No sample is newer than the last one, whatever a command says: it would keep all others waiting.
            newest_ns = self._next_sample_ns - self.period_ns
            at_ns = max(at_ns, min(sample_ns, newest_ns) + self._actuation_delay_ns)
        effective = max(at_ns, self._time_ns)
        if self._commands:
            effective = max(effective, self._commands[-1][0])
        self._commands.append((effective, self._converted(current)))
        self._last_command_ns = effective

    def enable(self) -> None:
        if self._state is State.FAULT:
            raise HardwareError(f"a fault is latched: {self._fault}")
        if self._state is State.OFF:
            self._state = State.ON
            self._bias = self._parameters.plant.actuator.bias_current
            self._last_command_ns = max(self._last_command_ns, self._time_ns)

    def disable(self) -> None:
        self._currents_off()
        if self._state is State.ON:
            self._state = State.OFF

    def reset_fault(self) -> None:
        if self._state is State.FAULT:
            self._state = State.OFF
            self._fault = ""

    def move(self, trajectory: Trajectory, start_ns: int) -> None:
        here = self._stage_position(self._time_ns)
        away = abs(trajectory.position(0) - here)
        if away > 1e-6:
            raise HardwareError(
                f"stage trajectory starts at {trajectory.position(0)} m, but the stage stands at {here} m"
            )
        self._trajectory, self._trajectory_start_ns = trajectory, start_ns

    @property
    def state(self) -> State:
        return self._state

    @property
    def fault(self) -> str:
        return self._fault

    @property
    def fault_kind(self) -> Fault | None:
        return Fault.COMMAND_TIMEOUT if self._fault else None

    @property
    def lost_samples(self) -> int:
        return self._lost

    @property
    def applied_current(self) -> float:
        return self._command

    def _stage_position(self, time_ns: int) -> float:
        return self._trajectory.position(time_ns - self._trajectory_start_ns)

    def _currents_off(self) -> None:
        self._commands.clear()
        self._command = self._mean_command = self._impulse = 0.0
        self._hold_ns = NEVER
        self._holding = False
        self._bias = 0.0

    def _integrate(self, until_ns: int) -> None:
        commands = self._commands
        while True:
            if commands and commands[0][0] <= until_ns and commands[0][0] <= self._hold_ns:
                at_ns, current = commands.popleft()
                if self._state is State.ON:
                    self._mean_command += self._hold.weight * (current - self._mean_command)
                    self._hold_ns = at_ns + self._hold.after_ns
                    self._holding = False
                else:
                    current = self._command
            elif self._hold_ns <= until_ns:
                # The last command fought the error of its own moment; held for longer it drives the platform away.
                at_ns = self._hold_ns
                self._hold_ns, self._holding, self._anchor = NEVER, True, self._y
                self._count_impulse()
                current = self._held(0.0)
            else:
                break
            # Up to what comes next, if that is before the sample.
            end_ns = until_ns if until_ns < self._hold_ns else self._hold_ns
            if commands and commands[0][0] < end_ns:
                end_ns = commands[0][0]
            advance(
                self._constants,
                self._plant_state,
                self._bias,
                self._command,
                at_ns - self._time_ns,
                current,
                end_ns - at_ns,
            )
            self._command, self._time_ns = current, end_ns
        if self._time_ns < until_ns:
            advance(self._constants, self._plant_state, self._bias, self._command, until_ns - self._time_ns, 0.0, 0)
            self._time_ns = until_ns

    def _count_impulse(self) -> None:
        self._impulse = impulse_after(self._hold, self._impulse, self._command - self._mean_command)

    def _held(self, displacement: float) -> float:
        return self._converted(holding_current(self._hold, self._mean_command, self._impulse, displacement))

    def _miss_command(self) -> None:
        if self._state is State.ON:
            age_ms = (self._time_ns - self._last_command_ns) * 1e-6
            self._state = State.FAULT
            self._fault = f"no command for {age_ms:.1f} ms (command_timeout {self.command_timeout_ns * 1e-6:g} ms)"
            self._currents_off()

    def _sample(self) -> tuple[Sample, Truth]:
        y, velocity, _, control, _, friction, magnetic = self._plant_state.tolist()
        x = self._stage_position(self._time_ns)
        reading = self._reading
        measured = control if self._state is State.ON else math.nan
        truth = Truth(x, y, velocity, friction, magnetic, self._guide.deviation(x))
        self._y = reading(y)
        self._count_impulse()
        if self._holding:
            self._command = self._held(self._y - self._anchor)
        return Sample(self._time_ns, reading(x), self._y, measured), truth
