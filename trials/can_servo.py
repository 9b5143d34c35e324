"""Runs the closed loop over a faulty bus in simulated time: the real host and emulated board, with faults between them.

:mod:`trials.can` shows that each single fault is detected. This trial shows how the machine reacts: it keeps running,
or it stays in the latched safe state until it is reset, and then runs again.
"""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.hardware.can.backend import CanHardware
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator import Board
from straightcomp_ros.hardware.can.frames import Amplifier, Report
from straightcomp_ros.hardware.can.hub import ERROR, FD, NO_DATA, Faults, Frame, LinkCut
from straightcomp_ros.hardware.can.sample_numbers import together
from straightcomp_ros.hardware.interface import HardwareError, State
from straightcomp_ros.hardware.simulated import SimulatedParameters
from straightcomp_ros.model.motion import Trajectory, forward_and_back
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap
from trials.firmware_board import FirmwareBoard

_START_NS = 1_700_000_000_000_000_000
_TRANSIT_NS = 100_000
_DEAD_NS = 20_000_000
"""Duration of a cut: the shortest time after which both ends have opened the bus again."""
_REST_NS = 100_000_000
"""Time for which the trial leaves a latched fault before it resets it."""
_SWITCH_OFF_S = 0.002
"""Beyond the board's command timeout: its amplifier must be off so long after the host latched a fault."""
_REFERENCE = (0.0, 0.0, 0.0)


class ServoTrial:
    """Holds the platform while the stage moves, with faults in the frames of both sides.

    The trial is the clock, the bus (in place of the host's :class:`~straightcomp_ros.hardware.can.link.Link`), and the
    operator, who switches the amplifier on as soon as possible, and again after each latched fault.

    Args:
        rates: see :class:`~straightcomp_ros.hardware.can.hub.Faults`.
        guide: of the simulated machine.
        board: its DBC file and kind of bus, and the program of the firmware core, if that is the board.
        frames: samples to take.
        seed: of the faults.

    Attributes:
        injected: faults by kind, both directions together.
        state: of the amplifier at the end, as the host sees it.
        on: fraction of the time in which the servo was on.
        latched: number of latched faults, by their texts without times.
        unsafe: samples that the board took with the amplifier on although the host had latched a fault longer ago than
            the board's command timeout.
        unflagged_wrong: samples that the servo got with values or times other than those that the board sampled.

    Raises:
        HardwareError: the program cannot be started.
    """

    openings, transmit_full, overloads, problem, log = 1, 0, 0, "", None

    def __init__(
        self, rates: Mapping[str, float], guide: StraightnessMap, board: CanParameters, frames: int, seed: int = 1
    ) -> None:
        self._now, stage, simulated = _START_NS, StageParameters(), SimulatedParameters()
        self._period_ns = stage.period_ns
        self._to_host, self._to_board = Faults(rates, seed), Faults(rates, seed + 1)
        self._dead_until = self._fault_ns = 0
        self._unsafe_after_ns = round((simulated.command_timeout + _SWITCH_OFF_S) * 1e9)
        self._wire = board.make_wire()
        self._part_ids = {one.identifier for one in self._wire.parts}
        self._sent: list[Report] = []
        self._taken: list[tuple[float, float]] = []
        self._answers: list[tuple[int, float]] = []
        self.latched: Counter[str] = Counter()
        self.unsafe = self.unflagged_wrong = on = 0
        self._servo = Servo(make_law(ControlParameters(), stage))
        self._host = CanHardware(board, stage, lambda: self._now, self._link)
        kind = FirmwareBoard if board.firmware else Board
        self._board = kind(board, simulated, stage, guide, self._from_board)
        with contextlib.closing(self._board):
            self._board.start(self._now)
            self._board.machine.move(Trajectory(forward_and_back(stage.motion)), self._now)
            for _ in range(frames):
                self._period()
                on += self._host.state is State.ON
                self._operate()
        self.on, self.state = on / frames, self._host.state
        self.injected = {kind: self._to_host.injected[kind] + self._to_board.injected[kind] for kind in rates}

    def _link(
        self, _: CanParameters, identifiers: Sequence[int], receive: Callable[[Frame, int], None], *__: object
    ) -> ServoTrial:
        self._identifiers, self._receive = identifiers, receive
        return self

    def send(self, identifier: int, payload: bytes, *, fd: bool) -> bool:
        """Send a frame from the host to the board."""
        for frame in self._arriving(self._to_board, identifier, payload, fd):
            if not frame.flags & NO_DATA:
                self._board.receive(frame.identifier, frame.data, self._now)
        return True

    def _from_board(self, identifier: int, payload: bytes, fd: bool) -> None:
        if identifier in self._part_ids:
            self._sent.append(self._wire.reports[identifier].unpack(payload))
        if len(self._sent) == len(self._part_ids):
            sent = together(self._sent)
            self._sent.clear()
            if sent.x is not None and sent.y is not None:
                self._taken.append((sent.x, sent.y))
        for frame in self._arriving(self._to_host, identifier, payload, fd):
            if frame.flags & ERROR or frame.identifier in self._identifiers:
                self._receive(frame, self._now + _TRANSIT_NS)

    def _arriving(self, faults: Faults, identifier: int, payload: bytes, fd: bool) -> list[Frame]:
        if self._now < self._dead_until:
            return []
        try:
            return faults(Frame(self._now, identifier, FD if fd else 0, payload))
        except LinkCut:
            self._dead_until = self._now + _DEAD_NS
            return []

    def _period(self) -> None:
        """Commands half a period after their samples, then the next sample."""
        self._now += self._period_ns // 2
        for stamp_ns, current in self._answers:
            self._host.write(current, self._now, stamp_ns)
        self._now += self._period_ns - self._period_ns // 2
        self._board.cycle(self._now)
        self._answers = []
        for sample, _ in self._host.read(self._now):
            number, late_ns = divmod(sample.stamp_ns - _START_NS, self._period_ns)
            known = 0 <= number < len(self._taken) and self._taken[number] == (sample.x, sample.y)
            self.unflagged_wrong += not (known and late_ns < 2 * _TRANSIT_NS)
            command = self._servo.step(sample.stamp_ns, sample.y, sample.current, _REFERENCE)
            if command:
                self._answers.append((sample.stamp_ns, command.current))

    def _operate(self) -> None:
        host = self._host
        if host.state is State.OFF and self._answers:
            # Not before the host has received frames of the board.
            with contextlib.suppress(HardwareError):
                host.enable()
        if host.state is not State.FAULT:
            self._fault_ns = 0
            return
        if not self._fault_ns:
            self._fault_ns = self._now
            self.latched[re.sub(" (for|within) .*", "", host.fault)] += 1
        age_ns = self._now - self._fault_ns
        self.unsafe += age_ns > self._unsafe_after_ns and self._board.amplifier is Amplifier.ON
        if age_ns > _REST_NS:
            host.reset_fault()
