"""Measure the cost of packing and unpacking CAN frames, and count how many injected bus faults are detected.

Frames of known samples go through injected faults on both kinds of bus: each kind of fault alone, to the receiver, then
all together with the closed loop. With `--set driver.can.firmware=PROGRAM` the board is the firmware core. Exit code 1
if a fault was not detected, or a wrong sample used."""

from __future__ import annotations

import argparse
import contextlib
import random
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from straightcomp_ros.bench.step_costs import cost
from straightcomp_ros.cli.options import add_parameter_options, chosen_parameters, in_range
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.hardware.can.backend import CanHardware
from straightcomp_ros.hardware.can.board_dbc import Wire
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator import Board, BoardProgram
from straightcomp_ros.hardware.can.frames import BoardFault, Command, Report
from straightcomp_ros.hardware.can.hub import ERROR, FD, FD_FRAME, FLOOD, KINDS, NO_DATA, Faults, Frame, LinkCut
from straightcomp_ros.hardware.can.receiver import Receiver
from straightcomp_ros.hardware.can.sample_numbers import BLOCK, together
from straightcomp_ros.hardware.interface import HardwareError, State
from straightcomp_ros.hardware.simulated import SimulatedParameters
from straightcomp_ros.model.motion import Trajectory, forward_and_back
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap
from trials.rig import tracked

SUMMARY = "µs per CAN frame, bus faults injected and found"
_REPEATS, _CALLS = 25, 1000
_RATE = 0.02
_TOGETHER = {kind: 0.0002 if kind == "cut" else 0.002 for kind in KINDS}
"""Rates of all kinds together, for a closed loop that stays on most of the time."""
COUNTED = tuple(kind for kind in KINDS if kind != "cut")
"""Kinds that damage one frame. A cut affects the link, and is tested on a real one."""
_REPORT = Report(4, 4, 1.2345678, -67.8e-6, -0.09, State.ON, 0, True, True)
_COMMAND = Command(3, True, False, -0.05, 4)
_COUNT, _CURRENT = 1e-7, 0.01
"""m of a count of the positions here, and A."""
_ROUNDED = 2e-7
"""m; what a float of 32 bits leaves of a position of 2 m. From sample to sample y changes by more."""
_DRIFT = 100e-6
"""Of the board's clock."""
_LEAD_IN = 4 * BLOCK
_TRANSIT_NS = 100_000
_START_NS = 1_700_000_000_000_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    kind, text = in_range(int, 1000), "samples sent for each kind of fault (default: %(default)s)"
    parser.add_argument("--frames", type=kind, default=20_000, help=text)


def run(options: argparse.Namespace) -> int:
    driver, frames = node_parameters("driver", chosen_parameters(options)), options.frames
    can, guide = driver.can, driver.guide()
    # Both kinds of bus of the package's own DBC file, or the one of another.
    boards = {Path(can.dbc).stem: can} if can.dbc else {"classic": replace(can, fd=False), "fd": replace(can, fd=True)}
    costs, loops, wrong = dict[str, dict[str, float]](), dict[str, dict[str, Any]](), 0
    counts = {kind: Counter[str](injected=0, detected=0) for kind in COUNTED}
    for bus, board in boards.items():
        costs |= codec_costs(board.make_wire())
        for kind in tracked(COUNTED, bus):
            trial = run_trial(kind, board, frames)
            counts[kind].update(injected=trial.injected, detected=trial.detected)
            wrong += trial.unflagged_wrong
        loop = ServoTrial(_TOGETHER, guide, board, frames)
        wrong += loop.unflagged_wrong
        loops[bus] = {name: getattr(loop, name) for name in ("on", "latched", "unsafe")}
        loops[bus]["injected"] = sum(loop.injected.values())
    print_json({"codec": costs, "frames": frames, "faults": counts, "closed_loop": loops, "unflagged_wrong": wrong})
    missed = any(count["injected"] != count["detected"] for count in counts.values())
    return int(missed or wrong > 0 or any(loop["unsafe"] for loop in loops.values()))


def codec_costs(wire: Wire) -> dict[str, dict[str, float]]:
    """Least time in µs to pack (``pack_us``) and to unpack (``unpack_us``) each frame, by its name in the DBC file."""

    def least_us(work: Callable[[Any], object], argument: Any) -> float:
        return cost(lambda: [work(argument) for _ in range(_CALLS)], _CALLS, _REPEATS)["min_us"]

    frames = [*((one, _REPORT) for one in wire.reports.values()), *((one, _COMMAND) for one in wire.commands)]
    return {
        one.name: {"pack_us": least_us(one.pack, values), "unpack_us": least_us(one.unpack, one.pack(values))}
        for one, values in frames
    }


class Trial(NamedTuple):
    """Faults of the encoder's frames, how many of them the receiver counted, and the samples that it accepted;
    ``unflagged_wrong`` are those with a number, position or time of no sample that was taken."""

    injected: int
    detected: int
    accepted: int
    unflagged_wrong: int


def run_trial(kind: str, board: CanParameters, frames: int) -> Trial:
    """Send ``frames`` samples of a board, with faults of one kind alone once the clock has settled."""
    # The error counter would end a real run; here every single fault must be seen.
    receiver = Receiver(replace(board, strike_limit=1000, sample_memory=100_000), StageParameters())
    faults, chance = Faults({kind: _RATE}, seed=1), random.Random(1)
    period_ns = 500_000 * (1.0 + _DRIFT)
    for k in range(frames):
        arrival_ns = _START_NS + round(k * period_ns) + _TRANSIT_NS + round(chance.expovariate(1 / 40e3))
        for frame in _frames(receiver.wire, k, arrival_ns):
            # Count only the faults of one frame of each sample, not those of the slow ones.
            hurt = k > _LEAD_IN and frame.identifier == receiver.wire.sample.identifier and k < frames - 2
            for arrived in faults(frame) if hurt else [frame]:
                receiver.take(arrived, arrived.stamp_ns)
    wrong = 0
    for index, sample, _ in receiver.samples:
        x, y = _position(index)
        good = abs(sample.x - x) < _ROUNDED and abs(sample.y - y) < _ROUNDED
        late_ns = sample.stamp_ns - _START_NS - round(index * period_ns) - _TRANSIT_NS
        wrong += not (good and 0 <= index < frames and abs(late_ns) < 100_000)
    return Trial(faults.injected[kind], _detected(receiver, kind), len(receiver.samples), wrong)


def _detected(receiver: Receiver, kind: str) -> int:
    counts, sequence, sets = receiver.counts, receiver.sequence, receiver.sets
    checks = sum(counts[check] for check in ("length", "crc", "alive", "state", "implausible"))
    return {
        "drop": sequence.lost,
        "duplicate": sequence.repeated + sets.repeated,
        "reorder": sequence.out_of_order + sets.out_of_order,
        "wrong_id": counts["foreign"] + checks,
        "error_frame": counts["error_frames"],
        "remote": counts["remote"],
        "flood": counts["foreign"] // FLOOD,
    }.get(kind, checks)


def _position(index: int) -> tuple[float, float]:
    """x and y in m at the sample ``index``, to and fro: the stage at 0.3 m/s, the platform at 1.4 mm/s."""
    x, y = 17_600_000, 440
    x_counts, y_counts = x - abs(1500 * index % (2 * x) - x), y // 2 - abs(7 * index % (2 * y) - y)
    return x_counts * _COUNT, y_counts * _COUNT


def _frames(wire: Wire, index: int, stamp_ns: int) -> Iterator[Frame]:
    x, y = _position(index)
    counter, fault = index % (wire.number_modulus or 2**32), wire.fault_codes[BoardFault.NONE]
    for frames in wire.reports.values():
        if index % frames.every == 0:
            alive = index // frames.every % frames.alive_modulus
            report = Report(alive, counter, x, y, _CURRENT, State.ON, fault, True, True)
            yield Frame(stamp_ns, frames.identifier, FD_FRAME if frames.fd else 0, frames.pack(report, index))


_DEAD_NS = 20_000_000
"""Duration of a cut: the shortest time after which both ends have opened the bus again."""
_REST_NS = 100_000_000
"""Time for which the trial leaves a latched fault before it resets it."""
_SWITCH_OFF_S = 0.002
"""Beyond the board's command timeout: its amplifier must be off so long after the host latched a fault."""
_REFERENCE = (0.0, 0.0, 0.0)


class ServoTrial:
    """Holds the platform while the stage moves, in simulated time: the real host and the emulated board, with faults in
    the frames of both sides. The machine keeps running, or stays in the latched safe state until it is reset.

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
        if host.fault is None:
            self._fault_ns = 0
            return
        if not self._fault_ns:
            self._fault_ns = self._now
            self.latched[re.sub(" (for|within) .*", "", host.fault[1])] += 1
        age_ns = self._now - self._fault_ns
        self.unsafe += age_ns > self._unsafe_after_ns and self._board.amplifier is State.ON
        if age_ns > _REST_NS:
            host.reset_fault()


_TICK, _RECEIVE, _FRAME = struct.Struct("=cq"), struct.Struct("=cqI"), struct.Struct("=cBI")
_DONE = struct.Struct("=cBBBIII")
"""Packets as firmware/posix/machine.h names them."""
_STATES = dict(enumerate(State, 1))
"""By the numbers of firmware/core/wire.h."""


class FirmwareBoard:
    """Used as :class:`~straightcomp_ros.hardware.can.emulator.Board` is: frames go out through ``send`` and come in
    through :meth:`receive`, at times that the caller passes in."""

    def __init__(
        self,
        can: CanParameters,
        parameters: SimulatedParameters,
        stage: StageParameters,
        guide: StraightnessMap,
        send: Callable[[int, bytes, bool], None],
    ) -> None:
        self._board = BoardProgram(can, parameters, stage, guide)
        self._send = send
        self._command_ids = {frames.identifier for frames in can.make_wire().commands}
        self.machine, self.start = self._board.machine, self.cycle

    def cycle(self, now_ns: int) -> None:
        """Take and send the samples up to ``now_ns``."""
        self._call(_TICK.pack(b"T", now_ns))

    def receive(self, identifier: int, payload: bytes, at_ns: int) -> None:
        """Take a frame that arrived at ``at_ns``."""
        if identifier in self._command_ids:
            self._call(_RECEIVE.pack(b"R", at_ns, identifier) + payload)
        else:
            self._board.stage.obey(identifier, payload, self.machine, at_ns)

    def _call(self, packet: bytes) -> None:
        self._board.send(packet)
        while (answer := self._board.receive())[:1] != b"E":
            if answer[:1] == b"F":
                _, fd, identifier = _FRAME.unpack_from(answer)
                self._send(identifier, answer[_FRAME.size :], bool(fd))
            else:
                self._board.answer(answer)
        _, amplifier, fault, commanded, alive, self.counter, self.refused_commands = _DONE.unpack(answer)
        self.command_alive = alive if commanded else None
        self.amplifier, self.fault = _STATES[amplifier], BoardFault(fault)

    def close(self) -> None:
        """End the program."""
        self._board.close()
