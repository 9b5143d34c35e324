"""What commissioning asks of a machine, the simulated stage as one (a running graph is another), and what a step takes
and gives.

Each call of a machine leaves the amplifier off, whatever happens in it, and raises `CommissioningError` if the machine
fails.
"""

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.current_path import advanced, readback_lag
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams, values_at
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.contract import COMMAND, DRIVER_STATE, ENCODER
from straightcomp_ros.control.excitation import (
    ExcitationParameters,
    MultisineParameters,
    bearable_travel,
    simple_currents,
)
from straightcomp_ros.control.law import Command
from straightcomp_ros.hardware.interface import Hardware, Sample, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import with_values
from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.parameters.node_parameters import DriverNodeParameters, Values, by_node, node_parameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.survey import Survey
from straightcomp_ros.tuning.commissioning import CommissioningError, LeftTravel
from straightcomp_ros.tuning.frequency_response.measured_response import ComparedResponse, measure_simulated

Array = NDArray[np.float64]

COASTING = 0.1
"""s that a series goes on for when the amplifier has been switched off."""


@dataclass(frozen=True, eq=False)
class Series:
    """Samples in the order of their stamps; all arrays (n,)."""

    stamps: NDArray[np.int64]  # ns
    x: Array  # readings, m
    y: Array
    current: Array  # measured control current of the coils, A; NaN while the amplifier is off
    command: Array  # commanded in answer to each sample, A
    latency: Array  # from each sample until its command arrived at the machine's driver, s; NaN where none arrived
    left_at: int | None = None
    """The sample at which the platform was beyond the travel that was allowed, and the amplifier went off; those after
    it show how far it coasts. None if it stayed within."""


class Machine(Protocol):
    """A machine under commissioning."""

    @property
    def simulated(self) -> bool:
        """Whether there is no real one."""

    def listen(self, seconds: float) -> Series:
        """Samples with the amplifier off."""

    def play(self, excitation: ExcitationParameters) -> Series:
        """Samples in open loop, from the first current of a shake or a ramp on; the amplifier goes off as soon as y has
        moved by the excitation's ``travel``.

        The series then goes on for some samples, in which the platform comes to rest.
        """

    def stroke(self, values: Values, bag: Path, travel: float, count: int = 1) -> None:
        """Some cycles of the stage, one after the other, under the controller of ``values``, recorded as ``bag``.

        Raises:
            LeftTravel: y was farther than ``travel`` (m) from its reference; the amplifier went off at once.
        """

    def response(self, values: Values, excitation: MultisineParameters) -> ComparedResponse:
        """The frequency response under the controller of ``values``."""


class SimulatedMachine(Machine):
    """The simulated stage; what the controller is given never changes it.

    ``values`` are parameters by node and dotted name; those of the driver are the machine's: ``parameters``, by dotted
    name, with the whole description. ``wiring`` puts something between the machine and its driver, for trials with
    broken machines.
    """

    simulated = True

    def __init__(self, values: Values, wiring: Callable[[SimulatedHardware], Hardware] | None = None) -> None:
        self._wiring = wiring
        self._driver: DriverNodeParameters = node_parameters("driver", values)
        # Its own copy of the description: what is found out about the machine must not change it.
        described = {f"stage.{name}": value for name, value in to_mapping(self._driver.stage).items()}
        self.parameters: Mapping[str, Any] = {**values.get("driver", {}), **described}

    def listen(self, seconds: float) -> Series:
        return self._run(np.zeros(round(seconds * self._driver.stage.rate)), None)

    def play(self, excitation: ExcitationParameters) -> Series:
        return self._run(simple_currents(excitation, self._driver.stage), excitation.travel)

    def stroke(self, values: Values, bag: Path, travel: float, count: int = 1) -> None:
        whole = {**values, "driver": self.parameters}
        with self._switched_off_after() as wiring:
            simulation = Simulation(whole, wiring=wiring)
            shutil.rmtree(bag, ignore_errors=True)
            with SimulatedRun(bag, by_node(whole), simulation.delay) as run:

                def observe(
                    sample: Sample, truth: Truth, reference: Sequence[float], command: Command, age: float
                ) -> None:
                    run.add(sample, truth, reference, command, age)
                    strayed = abs(sample.y - reference[0])
                    if not strayed <= travel:
                        raise LeftTravel(
                            f"the platform left its reference by {strayed * 1e6:.0f} µm under law "
                            f"'{simulation.law}' (allowed: {travel * 1e6:.0f} µm) {sample.stamp_ns * 1e-9:.2f} s after "
                            "the start; the machine is not as described: look at the count of the encoder of y, at the "
                            "platform, and at the magnets"
                        )

                for _ in range(count):
                    simulation.run(observe=observe)
                simulation.save_learning()

    def response(self, values: Values, excitation: MultisineParameters) -> ComparedResponse:
        with self._switched_off_after() as wiring:
            return measure_simulated({**values, "driver": self.parameters}, excitation, wiring=wiring)

    @contextmanager
    def _switched_off_after(self) -> Iterator[Callable[[SimulatedHardware], Hardware]]:
        """The wiring, whose machines are off afterwards whatever happens: a simulation leaves the amplifier on."""
        wired: list[Hardware] = []

        def kept(hardware: SimulatedHardware) -> Hardware:
            wired.append(self._wiring(hardware) if self._wiring else hardware)
            return wired[-1]

        try:
            yield kept
        finally:
            for hardware in wired:
                hardware.disable()

    def _run(self, currents: Array, travel: float | None) -> Series:
        """One sample for each of ``currents``; without a ``travel`` the amplifier stays off."""
        driver, stage = self._driver, self._driver.stage
        delay_ns = round(stage.drive.delay * stage.period_ns)
        rows: list[tuple[int, float, float, float, float]] = []
        left_at: int | None = None
        with self._switched_off_after() as wiring:
            hardware = wiring(SimulatedHardware(driver.simulated, stage, driver.guide(), stage.motion.start))
            if travel is not None:
                hardware.enable()
            hardware.start(0)
            for index, asked in enumerate(currents.tolist()):
                now_ns = index * stage.period_ns
                for sample, _ in hardware.read(now_ns):
                    command = asked if left_at is None else 0.0
                    rows.append((sample.stamp_ns, sample.x, sample.y, sample.current, command))
                    if travel is not None and left_at is None and not abs(sample.y - rows[0][2]) <= travel:
                        left_at = len(rows) - 1
                        hardware.disable()
                if left_at is None:
                    hardware.write(asked, now_ns + delay_ns)
                elif len(rows) > left_at + round(COASTING * stage.rate):
                    break
        stamps = np.array([row[0] for row in rows], np.int64)
        x, y, measured, commands = np.array([row[1:] for row in rows]).reshape(-1, 4).T
        return Series(stamps, x, y, measured, commands, np.full(len(rows), delay_ns * 1e-9), left_at)


def recorded_series(bag: Path) -> Series:
    """All samples of ``bag``; those without a command have NaN for it.

    Raises:
        CommissioningError: the bag cannot be read.
    """
    wanted = (ENCODER, COMMAND, DRIVER_STATE)
    try:
        streams = read_streams(bag, {stream.topic: stream.layout for stream in wanted})
    except BagError as error:
        raise CommissioningError(str(error)) from error
    if ENCODER.topic not in streams:
        none = np.empty(0)
        return Series(np.empty(0, np.int64), none, none, none, none, none)
    encoder = streams[ENCODER.topic].by_stamp()
    x, y, current = (encoder.columns[name] for name in ("x", "y", "coil_current"))
    current = advanced(current, readback_lag(bag))
    command = values_at(streams.get(COMMAND.topic), "control_current", encoder.stamp)
    latency = values_at(streams.get(DRIVER_STATE.topic), "command_latency", encoder.stamp)
    return Series(encoder.stamp, x, y, current, command, latency)


def recorded_reading(bag: Path, travel: float = math.inf) -> Array:
    """y (n,) in m of ``bag``; none where it cannot be read, as where a motion ended before anything was recorded. Of a
    platform that was held again after it had left ``travel`` (m): until then."""
    try:
        series = recorded_series(bag)
    except CommissioningError:
        return np.empty(0)
    held = series.y[np.isfinite(series.command)]
    left = np.flatnonzero(np.abs(held - held[-1:]) > travel)
    return held[: left[-1] + 1] if left.size else series.y


def excited(series: Series, travel: float, rate: float) -> Series:
    """An open-loop series from its first current on, until the platform has come to rest.

    The series is of a graph under the law `open_loop`, whose commands are those of the excitation. Beyond ``travel`` in
    m the amplifier went off.

    Raises:
        CommissioningError: the amplifier is never on.
    """
    on = np.isfinite(series.current)
    acting = np.flatnonzero(np.nan_to_num(series.command) != 0.0)
    if not on.any():
        raise CommissioningError("the amplifier is off throughout the bag")
    # A ramp begins with a zero of its own. Without any current the magnets pulled the platform away by themselves.
    first = max(0, int(acting[0]) - 1) if acting.size else int(np.argmax(on))
    off = np.flatnonzero(np.isnan(series.current[first:]))
    end = first + int(off[0]) if off.size else len(series.stamps)
    beyond = np.flatnonzero(~(np.abs(series.y[first:] - series.y[first]) <= travel))
    left_at = int(beyond[0]) if beyond.size else None
    if left_at is not None:
        # Until the platform has come to rest.
        end = max(end, first + left_at + 1) + round(COASTING * rate)
    cut = {one.name: getattr(series, one.name)[first:end] for one in fields(series) if one.name != "left_at"}
    return Series(**{**cut, "command": np.nan_to_num(cut["command"])}, left_at=left_at)


@dataclass(frozen=True)
class Outcome:
    """The result of a step."""

    passed: bool  # whether commissioning may go on
    sentence: str  # what was found, and where it did not pass, what would help
    figures: Mapping[str, Any] = field(default_factory=dict)  # by name with unit; plain numbers, texts, lists, mappings
    stage: Mapping[str, Any] = field(default_factory=dict)  # facts of the description as found, by dotted name
    gains: Mapping[str, Any] = field(default_factory=dict)  # of the law from here on, by dotted name in the controller
    before: Mapping[str, Any] = field(default_factory=dict)  # facts that a design must know: it is made once more


@dataclass(frozen=True)
class Work:
    """What a step works on."""

    machine: Machine
    values: Mapping[str, Mapping[str, Any]]  # by node and dotted name, with what the steps before found
    description: StageParameters  # the stage as first described, with its uncertainty
    folder: Path  # for bags and other files
    evaluations: int  # candidates of the search for gains
    machines: int  # uncertain machines of its verification
    outcomes: Mapping[str, Outcome] = field(default_factory=dict)  # of the steps that are done, by name
    learning_strokes: int = 0  # cycles in which the law's reference is corrected before the acceptance
    check_survey: Survey | None = None  # an independent measurement of the guide, by which the map is checked
    require: float | None = None  # largest straightness after compensation in µm, with its uncertainty
    progress: Callable[[float], None] = lambda fraction: None  # called with the fraction of the step that is done

    @property
    def stage(self) -> StageParameters:
        """The stage as known so far."""
        stage: StageParameters = node_parameters("controller", self.values).stage
        return stage

    @property
    def travel(self) -> float:
        """How far the platform may be from its reference under any law, m."""
        return bearable_travel(self.stage)

    def given(self, node: str, changes: Mapping[str, Any]) -> "Work":
        """The same with ``changes`` of parameters of ``node``, by dotted name."""
        return replace(self, values=with_values(self.values, node, changes))

    def described(self) -> dict[str, Mapping[str, Any]]:
        """The parameters of a simulated machine that is as the stage is known so far, without a truth of its own."""
        own = {
            name: value
            for name, value in self.values.get("driver", {}).items()
            if not name.startswith(("simulated.truth.", "stage."))
        }
        return {**self.values, "driver": own}
