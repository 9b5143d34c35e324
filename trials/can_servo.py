"""Runs the closed loop over a faulty bus in simulated time: the real host and emulated board, with faults between them.

:mod:`trials.can_faults` shows that each single fault is detected. This trial shows how the
machine reacts: it keeps running, or it stays in the latched safe state until it is reset, and then runs again.
"""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.hardware.can.backend import CanHardware
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator import Board
from straightcomp_ros.hardware.can.frames import Amplifier, Report
from straightcomp_ros.hardware.can.hub import ERROR, FD, NO_DATA, Faults, Frame, LinkCut
from straightcomp_ros.hardware.can.sample_numbers import together
from straightcomp_ros.hardware.interface import HardwareError, State
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
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


@dataclass(frozen=True)
class ServoTrial:
    """Result of a trial of the closed loop.

    Attributes:
        frames: samples that the board sent.
        injected: faults by kind, both directions together.
        state: of the amplifier at the end, as the host sees it.
        on: fraction of the time in which the servo was on.
        latched: number of latched faults, by their texts without times.
        unsafe: samples that the board took with the amplifier on although the host had latched a fault longer ago than
            the board's command timeout.
        unflagged_wrong: samples that the servo got with values or times other than those that the board sampled.
    """

    frames: int
    injected: Mapping[str, int]
    state: State
    on: float
    latched: Mapping[str, int]
    unsafe: int
    unflagged_wrong: int


def run_servo_trial(
    rates: Mapping[str, float], guide: StraightnessMap, board: CanParameters, *, frames: int = 20_000, seed: int = 1
) -> ServoTrial:
    """Hold the platform for ``frames`` samples while the stage moves, with faults in the frames of both sides.

    The trial switches the amplifier on as soon as possible, and again after each latched fault.

    Args:
        rates: see :class:`~straightcomp_ros.hardware.can.hub.Faults`.
        guide: of the simulated machine.
        board: its DBC file and kind of bus, and the program of the firmware core, if that is the board.
        frames: samples to take.
        seed: of the faults.

    Raises:
        HardwareError: the program cannot be started.
    """
    trial = _Trial(rates, guide, board, seed)
    with contextlib.closing(trial.board):
        for _ in range(frames):
            trial.period()
    injected = Counter(trial.to_host.injected) + Counter(trial.to_board.injected)
    return ServoTrial(
        frames,
        {kind: injected[kind] for kind in rates},
        trial.host.state,
        trial.on / frames,
        dict(trial.latched),
        trial.unsafe,
        trial.wrong,
    )


class _Trial:
    """Clock, bus and operator; also replaces the host's :class:`~straightcomp_ros.hardware.can.link.Link`."""

    openings, transmit_full, overloads, problem, log = 1, 0, 0, "", None

    def __init__(self, rates: Mapping[str, float], guide: StraightnessMap, board: CanParameters, seed: int) -> None:
        self.now, stage = _START_NS, StageParameters()
        self.to_host, self.to_board = Faults(rates, seed), Faults(rates, seed + 1)
        self._dead_until = 0
        self._wire = board.make_wire()
        self._part_ids = {frames.identifier for frames in self._wire.parts}
        self._sent: list[Report] = []
        self.host = CanHardware(board, stage, lambda: self.now, self._link)
        simulated, self._period_ns = SimulatedParameters(), stage.period_ns
        self.board: Board | FirmwareBoard
        if board.firmware:
            self.board = FirmwareBoard(board, simulated, stage, guide, self._from_board, self.now)
        else:
            machine = SimulatedHardware(simulated, stage, guide)
            self.board = Board(machine, self._wire, stage.drive.current_range, self._from_board, self.now)
        self.board.machine.move(Trajectory(forward_and_back(stage.motion)), self.now)
        self._servo = Servo(make_law(ControlParameters(), stage))
        self._answers: list[tuple[int, float]] = []
        self._taken: list[tuple[float, float]] = []
        self._fault_ns = 0
        self._unsafe_after_ns = round((simulated.command_timeout + _SWITCH_OFF_S) * 1e9)
        self.latched: Counter[str] = Counter()
        self.on = self.unsafe = self.wrong = 0

    def start(self) -> None:
        """The bus is open from the beginning."""

    def close(self) -> None:
        """Nothing to close."""

    def _link(
        self, _: CanParameters, identifiers: Sequence[int], receive: Callable[[Frame, int], None], *__: object
    ) -> _Trial:
        self._identifiers, self._receive = identifiers, receive
        return self

    def send(self, identifier: int, payload: bytes, *, fd: bool) -> bool:
        """Send a frame from the host to the board."""
        for frame in self._arriving(self.to_board, identifier, payload, fd):
            if not frame.flags & NO_DATA:
                self.board.receive(frame.identifier, frame.data, self.now)
        return True

    def _from_board(self, identifier: int, payload: bytes, fd: bool) -> None:
        if identifier in self._part_ids:
            self._sent.append(self._wire.reports[identifier].unpack(payload))
        if len(self._sent) == len(self._part_ids):
            sent = together(self._sent)
            self._sent.clear()
            if sent.x is not None and sent.y is not None:
                self._taken.append((sent.x, sent.y))
        for frame in self._arriving(self.to_host, identifier, payload, fd):
            if frame.flags & ERROR or frame.identifier in self._identifiers:
                self._receive(frame, self.now + _TRANSIT_NS)

    def _arriving(self, faults: Faults, identifier: int, payload: bytes, fd: bool) -> list[Frame]:
        if self.now < self._dead_until:
            return []
        try:
            return faults(Frame(self.now, identifier, FD if fd else 0, payload))
        except LinkCut:
            self._dead_until = self.now + _DEAD_NS
            return []

    def period(self) -> None:
        """Run one period: commands half a period after their samples, then the next sample."""
        self.now += self._period_ns // 2
        for stamp_ns, current in self._answers:
            self.host.write(current, self.now, stamp_ns)
        self.now += self._period_ns - self._period_ns // 2
        self.board.cycle(self.now)
        self._answers = []
        for sample, _ in self.host.read(self.now):
            self._check(sample.stamp_ns, (sample.x, sample.y))
            command = self._servo.step(sample.stamp_ns, sample.y, sample.current, _REFERENCE)
            if command:
                self._answers.append((sample.stamp_ns, command.current))
        self._operate()

    def _check(self, stamp_ns: int, place: tuple[float, float]) -> None:
        number = round((stamp_ns - _TRANSIT_NS - _START_NS) / self._period_ns)
        late_ns = stamp_ns - _TRANSIT_NS - _START_NS - number * self._period_ns
        known = 0 <= number < len(self._taken) and self._taken[number] == place
        self.wrong += not (known and abs(late_ns) < _TRANSIT_NS)

    def _operate(self) -> None:
        state = self.host.state
        self.on += state is State.ON
        if state is not State.FAULT:
            self._fault_ns = 0
            if state is State.OFF and self._answers:
                try:
                    self.host.enable()
                except HardwareError:
                    # Not before the host has received frames of the board.
                    return
            return
        if not self._fault_ns:
            self._fault_ns = self.now
            self.latched[re.sub(" (for|within) .*", "", self.host.fault)] += 1
        age_ns = self.now - self._fault_ns
        self.unsafe += age_ns > self._unsafe_after_ns and self.board.amplifier is Amplifier.ON
        if age_ns > _REST_NS:
            self.host.reset_fault()
