"""The simulated stage as a machine under commissioning, in simulated time."""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.control.excitation import ExcitationParameters, MultisineParameters, simple_currents
from straightcomp_ros.control.law import Command
from straightcomp_ros.hardware.interface import Hardware, Sample, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.parameters.node_parameters import DriverNodeParameters, Values, by_node, node_parameters
from straightcomp_ros.tuning.commissioning import LeftTravel
from straightcomp_ros.tuning.commissioning.machine import COASTING, Array, Series
from straightcomp_ros.tuning.frequency_response.simulated_measurement import ComparedResponse, measure_simulated


def sound(hardware: SimulatedHardware) -> Hardware:
    """The machine as its parameters say."""
    return hardware


class SimulatedMachine:
    """The simulated stage; what the controller is given never changes it.

    Args:
        values: parameters by node and dotted name; those of the driver are the machine's.
        wiring: puts something between the machine and its driver, for trials with broken machines.

    Attributes:
        parameters: of the driver, by dotted name, with the whole description.
    """

    def __init__(self, values: Values, wiring: Callable[[SimulatedHardware], Hardware] = sound) -> None:
        self._wiring = wiring
        self._driver: DriverNodeParameters = node_parameters("driver", values)
        # Its own copy of the description: what is found out about the machine must not change it.
        described = {f"stage.{name}": value for name, value in to_mapping(self._driver.stage).items()}
        self.parameters: Mapping[str, Any] = {**values.get("driver", {}), **described}

    def listen(self, seconds: float) -> Series:
        """See `Machine`."""
        hardware = self._hardware()
        return self._run(hardware, np.zeros(round(seconds * self._driver.stage.rate)), np.inf)

    def play(self, excitation: ExcitationParameters) -> Series:
        """See `Machine`."""
        hardware = self._hardware()
        hardware.enable()
        try:
            return self._run(hardware, simple_currents(excitation, self._driver.stage), excitation.travel)
        finally:
            hardware.disable()

    def stroke(self, values: Values, bag: Path, travel: float, count: int = 1) -> None:
        """See `Machine`."""
        whole = self._with_controller(values)
        wired: list[Hardware] = []
        simulation = Simulation(whole, wiring=lambda hardware: self._kept(hardware, wired))
        shutil.rmtree(bag, ignore_errors=True)
        with self._off_after(wired), SimulatedRun(bag, by_node(whole), simulation.delay) as run:

            def observe(sample: Sample, truth: Truth, reference: Sequence[float], command: Command, age: float) -> None:
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
        """See `Machine`."""
        wired: list[Hardware] = []
        with self._off_after(wired):
            return measure_simulated(
                self._with_controller(values), excitation, wiring=lambda hardware: self._kept(hardware, wired)
            )

    def _kept(self, hardware: SimulatedHardware, wired: list[Hardware]) -> Hardware:
        wired.append(self._wiring(hardware))
        return wired[-1]

    @staticmethod
    @contextmanager
    def _off_after(wired: list[Hardware]) -> Iterator[None]:
        """Whatever happens, the amplifier is off afterwards: a simulation leaves it on."""
        try:
            yield
        finally:
            for hardware in wired:
                hardware.disable()

    def _with_controller(self, values: Values) -> dict[str, Mapping[str, Any]]:
        return {**values, "driver": self.parameters}

    def _hardware(self) -> Hardware:
        driver = self._driver
        place = driver.stage.motion.start
        return self._wiring(SimulatedHardware(driver.simulated, driver.stage, driver.guide(), place))

    def _run(self, hardware: Hardware, currents: Array, travel: float) -> Series:
        stage = self._driver.stage
        delay_ns = round(stage.drive.delay * stage.period_ns)
        rows: list[tuple[int, float, float, float, float]] = []
        left_at: int | None = None
        asked = currents.tolist()
        hardware.start(0)
        for index in range(len(asked)):
            now_ns = index * stage.period_ns
            for sample, _ in hardware.read(now_ns):
                rows.append((sample.stamp_ns, sample.x, sample.y, sample.current, asked[index]))
                if left_at is None and not abs(sample.y - rows[0][2]) <= travel:
                    left_at = len(rows) - 1
                    hardware.disable()
                    asked[index + 1 :] = [0.0] * len(asked[index + 1 :])
            if left_at is None:
                hardware.write(asked[index], now_ns + delay_ns)
            elif len(rows) > left_at + round(COASTING * stage.rate):
                break
        stamps = np.array([row[0] for row in rows], np.int64)
        x, y, measured, command = np.array([row[1:] for row in rows]).reshape(-1, 4).T
        latency = np.full(len(rows), delay_ns * 1e-9)
        return Series(stamps, x, y, measured, command, latency, left_at)
