"""Emulates the DSP board on the CAN bus, as the simulated machine of the driver's parameters. It uses no ROS."""

import dataclasses
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from straightcomp_ros.hardware.can.emulator import Board, BoardProgram, program_arguments
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.hub import Hub
from straightcomp_ros.hardware.can.hub_bus import INTERFACE
from straightcomp_ros.hardware.can.link import BusLine, HubLine, Line
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.parameters.node_parameters import DriverNodeParameters
from straightcomp_ros.runtime.loops import PeriodicLoop
from straightcomp_ros.timing import realtime
from straightcomp_ros.timing.realtime import RealtimeParameters

_MOST_PRIORITY = 98
_LEAD_NS = 120_000
"""Time in which this process wakes up, simulates and sends. A board takes none, so the process begins this much
before the sampling time."""


class Emulator:
    """The board's loop on its bus. The driver's parameters describe its simulated machine; ``drift`` is the relative
    frequency error of its clock."""

    def __init__(self, parameters: DriverNodeParameters, line: Line, drift: float = 0.0) -> None:
        self._line = line
        self._rate = 1.0 + drift
        self._origin_ns = time.monotonic_ns()
        self._refused = ""
        self.unsent = 0
        """Frames that the bus did not accept."""
        self._parameters = parameters
        self._machine = SimulatedHardware(parameters.simulated, parameters.stage, parameters.guide())
        self._wire = parameters.can.make_wire()
        self._stage_frames = EmulatorFrames(parameters.can.node, self._wire)
        self._board: Board | None = None
        self.loop = PeriodicLoop(round(self._machine.period_ns / self._rate), self._cycle)

    def _board_ns(self, monotonic_ns: int) -> int:
        """Convert monotonic time to the board's clock."""
        return round((monotonic_ns - self._origin_ns) * self._rate)

    def _now_ns(self) -> int:
        return self._board_ns(time.monotonic_ns())

    def _switched_on(self, wake_ns: int) -> Board:
        # The board samples at this loop's wake-up times, so that a sample is not up to a period old when it is sent.
        return Board(
            self._machine,
            self._wire,
            self._parameters.stage.drive.current_range,
            self._send,
            self._board_ns(wake_ns) + _LEAD_NS,
            emulator=self._stage_frames,
            tells_truth=self._parameters.can.simulated_stage and self._parameters.can.fd,
        )

    def _cycle(self, wake_ns: int) -> None:
        if self._board is None:
            self._board = self._switched_on(wake_ns)
        board = self._board
        for identifier, payload, sent_ns in self._line.receive():
            # A command acts from its time on the bus, not from when this process read it.
            late_ns = max(0, time.time_ns() - sent_ns)
            board.receive(identifier, payload, self._now_ns() - late_ns)
        board.cycle(self._now_ns() + _LEAD_NS)
        self._refused = _logged(board.refused_trajectory, self._refused)

    def _send(self, identifier: int, payload: bytes, fd: bool) -> None:
        self.unsent += not self._line.send(identifier, payload, fd)

    def close(self) -> None:
        """Amplifier off, bus closed."""
        self._machine.close()
        self._line.close()


def _off_the_loop(driver: RealtimeParameters) -> RealtimeParameters:
    """The driver's real-time parameters, changed for an emulated board. Since a real board would not load the host, it
    leaves the loop's CPU to the loop and runs before other work. It shares no locks with the nodes."""
    cpus = realtime.REST if driver.cpus == realtime.LOOP else driver.cpus
    priority = min(driver.priority + 1, _MOST_PRIORITY) if driver.priority else 0
    return dataclasses.replace(driver, cpus=cpus, priority=priority, exclusive=False)


def _logged(refused: str, before: str) -> str:
    """Log a trajectory that was refused, once; returns what has been logged."""
    if refused != before:
        print(f"dsp_emulator: {refused}", file=sys.stderr, flush=True)
    return refused


def _schedule(driver: RealtimeParameters) -> None:
    for refusal in realtime.apply(_off_the_loop(driver)):
        print(f"dsp_emulator: {refusal}", file=sys.stderr)


def _run_firmware(parameters: DriverNodeParameters, stopped: Callable[[], bool], own_hub: bool) -> int:
    """Be the machine of the firmware core, which is a process of its own on the bus."""
    can, simulated, stage, guide = parameters.can, parameters.simulated, parameters.stage, parameters.guide()
    bus = str(Path(can.channel).absolute()) if can.interface == INTERFACE else can.channel
    arguments = program_arguments(can, simulated, stage, bus=bus, lead_ns=_LEAD_NS)
    hub = Hub(can.channel) if own_hub else None
    try:
        # The program inherits it.
        _schedule(parameters.realtime)
        program = BoardProgram(can, arguments, simulated, stage, guide)
        refused = ""

        def ended() -> bool:
            nonlocal refused
            refused = _logged(program.stage.refused, refused)
            return stopped()

        print("ready", flush=True)
        try:
            program.serve(ended, hub)
        finally:
            program.close()
    finally:
        if hub is not None:
            hub.close()
    return 0


def emulate(parameters: DriverNodeParameters, drift: float, *, own_hub: bool = False) -> int:
    """Emulate the board until SIGINT or SIGTERM, with ``own_hub`` the hub of the bus too; print ``ready`` when it
    samples.

    Raises:
        SurveyError: the guide's file cannot be used.
        HardwareError: the hub's socket cannot be made, or the firmware's program cannot be started or has ended.
    """
    stopping: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stopping.append(number))
    if parameters.can.firmware:
        return _run_firmware(parameters, lambda: bool(stopping), own_hub)
    line = HubLine(parameters.can.channel) if own_hub else BusLine(parameters.can)
    emulator = Emulator(parameters, line, drift)
    _schedule(parameters.realtime)
    print("ready", flush=True)
    try:
        emulator.loop.run(lambda: bool(stopping), idle=lambda: None)
    finally:
        emulator.close()
    return 0
