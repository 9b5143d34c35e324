"""Emulates the DSP board on the CAN bus, as the simulated machine of the driver's parameters. It uses no ROS."""

import dataclasses
import gc
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

from straightcomp_ros.cell.stop_signals import noting_stop
from straightcomp_ros.hardware.can.emulator import Board, BoardProgram
from straightcomp_ros.hardware.can.hub import NO_DATA, Frame, Hub
from straightcomp_ros.hardware.can.hub_bus import INTERFACE
from straightcomp_ros.hardware.can.link import Link
from straightcomp_ros.parameters.node_parameters import DriverNodeParameters
from straightcomp_ros.runtime.loops import PeriodicLoop
from straightcomp_ros.timing import realtime
from straightcomp_ros.timing.realtime import RealtimeParameters

_MOST_PRIORITY = 98
_LEAD_NS = 120_000
"""Time in which this process wakes up, simulates and sends. A board takes none, so the process begins this much
before the sampling time."""


class Emulator:
    """The board's loop on its bus. The driver's parameters describe its simulated machine. With ``own_hub`` it is
    the hub of the bus too, so that no other process has to wake up between board and host.

    Raises:
        HardwareError: the hub's socket cannot be made.
    """

    def __init__(self, parameters: DriverNodeParameters, *, own_hub: bool = False) -> None:
        self._origin_ns = time.monotonic_ns()
        self._said: tuple[str, ...] = ()
        can, stage = parameters.can, parameters.stage
        self._board = Board(can, parameters.simulated, stage, parameters.guide(), self._send)
        self._started = False
        self._line: Link | Hub
        if own_hub:
            self._line = Hub(can.channel, member=lambda frame: self._receive(frame, self._arrival(frame)))
        else:
            # The log of these parameters is the driver's.
            bus = dataclasses.replace(can, log="")
            self._line = Link(bus, self._board.identifiers, self._receive, self._now_ns)
            self._line.open()
        self.loop = PeriodicLoop(stage.period_ns, self._cycle)

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self._origin_ns

    def _arrival(self, frame: Frame) -> int:
        """A command acts from its time on the bus, not from when this process read it."""
        return self._now_ns() - max(0, time.time_ns() - frame.stamp_ns)

    def _send(self, identifier: int, payload: bytes, fd: bool) -> None:
        self._line.send(identifier, payload, fd=fd)

    def _receive(self, frame: Frame, arrival_ns: int) -> None:
        if not frame.flags & NO_DATA:
            self._board.receive(frame.identifier, frame.data, arrival_ns)

    def _cycle(self, wake_ns: int) -> None:
        if not self._started:
            # It samples at this loop's wake-up times, so that a sample is not up to a period old when it is sent.
            self._board.start(wake_ns - self._origin_ns + _LEAD_NS)
            self._started = True
        self._line.wait(0.0)
        self._board.cycle(self._now_ns() + _LEAD_NS)
        self._said = _logged(self._said, self._board.stage.refused, self._line.problem)

    def close(self) -> None:
        """Amplifier off, bus closed."""
        self._board.close()
        self._line.close()


def _logged(before: tuple[str, ...], *now: str) -> tuple[str, ...]:
    """Log each problem once, as long as it lasts; returns what has been logged."""
    for words in set(now) - {"", *before}:
        print(f"dsp_emulator: {words}", file=sys.stderr, flush=True)
    return now


def _schedule(driver: RealtimeParameters) -> None:
    """Since a real board would not load the host, an emulated one leaves the loop's CPU to the loop and runs before
    other work. It shares no locks with the nodes."""
    cpus = realtime.REST if driver.cpus == realtime.LOOP else driver.cpus
    priority = min(driver.priority + 1, _MOST_PRIORITY) if driver.priority else 0
    for refusal in realtime.apply(dataclasses.replace(driver, cpus=cpus, priority=priority, exclusive=False)):
        print(f"dsp_emulator: {refusal}", file=sys.stderr)


def _ready() -> None:
    # What was made by now is never garbage, and to look through it takes longer than a sample.
    gc.collect()
    gc.freeze()
    print("ready", flush=True)


def _run_firmware(parameters: DriverNodeParameters, stopped: Callable[[], bool], own_hub: bool) -> None:
    """Be the machine of the firmware core, which is a process of its own on the bus."""
    can, simulated, stage, guide = parameters.can, parameters.simulated, parameters.stage, parameters.guide()
    bus = str(Path(can.channel).absolute()) if can.interface == INTERFACE else can.channel
    with ExitStack() as closed:
        hub = closed.enter_context(closing(Hub(can.channel))) if own_hub else None
        # The program inherits it.
        _schedule(parameters.realtime)
        program = closed.enter_context(closing(BoardProgram(can, simulated, stage, guide, bus, _LEAD_NS)))
        said: tuple[str, ...] = ()

        def ended() -> bool:
            nonlocal said
            said = _logged(said, program.stage.refused)
            return stopped()

        _ready()
        program.serve(ended, hub)


def emulate(parameters: DriverNodeParameters, *, own_hub: bool = False) -> None:
    """Emulate the board until SIGINT, SIGTERM or SIGHUP, with ``own_hub`` the hub of the bus too; print ``ready`` when
    it samples.

    Raises:
        SurveyError: the guide's file cannot be used.
        HardwareError: the hub's socket cannot be made, or the firmware's program cannot be started or has ended.
    """
    stopping = noting_stop()
    if parameters.can.firmware:
        _run_firmware(parameters, stopping, own_hub)
        return
    with closing(Emulator(parameters, own_hub=own_hub)) as emulator:
        _schedule(parameters.realtime)
        _ready()
        emulator.loop.run(stopping, idle=lambda: None)
