"""The process that is the board on the bus: the simulated machine of the driver's parameters. No ROS."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import sys
import time

import can

from straightcomp_ros.configuration import DriverNodeParameters, RealtimeParameters
from straightcomp_ros.hardware.can.board import Board
from straightcomp_ros.hardware.can.frames import Codec
from straightcomp_ros.hardware.can.link import opened_bus
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.nodes import realtime
from straightcomp_ros.nodes.periodic import PeriodicLoop
from straightcomp_ros.straightness.map import load_map

_AT_ONCE = 64
_REOPEN_EVERY_S = 0.1


class Emulator:
    """The board's own loop, and its CAN controller, which comes back by itself after a loss of the bus.

    Args:
        parameters: of the driver: its simulated machine is this board's, its CAN bus too.
        drift: of the board's quartz, a fraction.
    """

    def __init__(self, parameters: DriverNodeParameters, drift: float = 0.0) -> None:
        self._parameters = parameters
        self._rate = 1.0 + drift
        self._origin_ns = time.monotonic_ns()
        self._bus: can.BusABC | None = None
        self._next_open_s = 0.0
        self._complained = self._refused = ""
        self.unsent = 0
        """Frames that the bus did not take."""
        machine = SimulatedHardware(parameters.simulated, load_map(parameters.guide))
        self._open()
        self.board = Board(
            machine,
            Codec(parameters.can.node, parameters.can.fd),
            parameters.simulated.plant.drive.current_range,
            self._send,
            self._now_ns(),
            tells_truth=parameters.can.simulated_stage,
        )
        self.loop = PeriodicLoop(round(machine.period_ns / self._rate), self._cycle)

    def _now_ns(self) -> int:
        """The board's clock."""
        return round((time.monotonic_ns() - self._origin_ns) * self._rate)

    def _cycle(self, _: int) -> None:
        if self._bus is None:
            self._open()
        self._drain()
        self.board.cycle(self._now_ns())
        if self.board.refused_trajectory != self._refused:
            self._refused = self.board.refused_trajectory
            print(f"dsp_emulator: {self._refused}", file=sys.stderr, flush=True)

    def _open(self) -> None:
        if time.monotonic() < self._next_open_s:
            return
        self._next_open_s = time.monotonic() + _REOPEN_EVERY_S
        try:
            self._bus = opened_bus(self._parameters.can)
            self._complained = ""
        except (can.CanError, OSError) as error:
            if str(error) != self._complained:
                self._complained = str(error)
                print(f"dsp_emulator: {error}", file=sys.stderr, flush=True)

    def _close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(can.CanError, OSError):
                bus.shutdown()

    def _send(self, identifier: int, payload: bytes, fd: bool) -> None:
        if self._bus is not None:
            message = can.Message(
                arbitration_id=identifier, is_extended_id=False, data=payload, is_fd=fd, bitrate_switch=fd
            )
            try:
                self._bus.send(message)
                return
            except (can.CanError, OSError):
                pass
        self.unsent += 1

    def _drain(self) -> None:
        if self._bus is None:
            return
        try:
            for _ in range(_AT_ONCE):
                message = self._bus.recv(0)
                if message is None:
                    return
                # Commands act from when they were on the bus, not from when this process got to them.
                late_ns = max(0, round((time.time() - message.timestamp) * 1e9))
                if not message.is_error_frame:
                    self.board.receive(message.arbitration_id, bytes(message.data), self._now_ns() - late_ns)
        except (can.CanError, OSError):
            self._close()

    def close(self) -> None:
        """Amplifier off, bus closed."""
        self.board.machine.close()
        self._close()


def _beside_the_loop(driver: RealtimeParameters) -> RealtimeParameters:
    """The driver's real-time parameters for a board: it is no part of the host, whose loop has its CPU to itself."""
    return dataclasses.replace(driver, cpus="rest") if driver.cpus == "loop" else driver


def emulate(parameters: DriverNodeParameters, drift: float) -> int:
    """Be the board until SIGINT or SIGTERM; prints ``ready`` when it samples.

    Raises:
        SurveyError: the guide's file is refused.
    """
    stopping: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stopping.append(number))
    emulator = Emulator(parameters, drift)
    for refusal in realtime.apply(_beside_the_loop(parameters.realtime)):
        print(f"dsp_emulator: {refusal}", file=sys.stderr)
    print("ready", flush=True)
    try:
        emulator.loop.run(lambda: bool(stopping), idle=lambda: None)
    finally:
        emulator.close()
    return 0
