"""A board whose firmware is the program of firmware/posix, and the simulated machine behind its encoders and amplifier.

The program and this process talk in packets over a socket, whose layouts firmware/posix/machine.h names. On a bus the
program keeps the time, and this process only answers what the encoders read. In lockstep this process has the bus and
the time too, so that a run can be repeated to the bit.
"""

import contextlib
import dataclasses
import math
import socket
import struct
import subprocess
from collections.abc import Callable, Sequence
from fractions import Fraction

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames, StageReceiver
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault
from straightcomp_ros.hardware.can.hub import Hub
from straightcomp_ros.hardware.can.message_code import Signals
from straightcomp_ros.hardware.interface import HardwareError
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap

_LONGEST = 256
_TICK, _RECEIVE = struct.Struct("=cq"), struct.Struct("=cqI")
_SAMPLE, _DRIVE, _STAGE, _FRAME = (struct.Struct(layout) for layout in ("=cqI", "=cqBi", "=cqI", "=cBI"))
_READING = struct.Struct("=iidBI")
_DONE = struct.Struct("=cBBBIII")
_LARGEST_DENOMINATOR = 2**20
_END_S = 2.0


def program_arguments(
    can: CanParameters, parameters: SimulatedParameters, stage: StageParameters, *, bus: str, lead_ns: int
) -> list[str]:
    """Arguments of the program, NAME=VALUE, for a board on a stage; ``bus`` is empty in lockstep."""
    drive, encoder, hold = stage.drive, stage.encoder, parameters.hold(stage)
    wire = can.make_wire()
    x, y = (
        _scale(own, wire.homes[name].signals, name)
        for own, name in ((encoder.x_resolution, "x"), (encoder.y_resolution, "y"))
    )
    values = {
        "bus": bus,
        "lead_ns": lead_ns,
        "node": can.node,
        "fd": int(can.fd),
        "source": wire.source(),
        "period_ns": stage.period_ns,
        "delay_ns": round(drive.delay * stage.period_ns),
        "current_limit": drive.current_range,
        "x_numerator": x.numerator,
        "x_denominator": x.denominator,
        "y_numerator": y.numerator,
        "y_denominator": y.denominator,
        "command_timeout_ns": round(parameters.command_timeout * 1e9),
        "hold_after_ns": hold.after_ns,
        "half_codes": drive.half_codes,
        "code_current": drive.current_step,
        "hold_weight": hold.weight,
        "hold_kept": hold.kept,
        "hold_braking": hold.braking,
        "hold_stiffness": hold.stiffness,
        "x_count": encoder.x_resolution,
        "y_count": encoder.y_resolution,
    }
    return [f"{name}={value!r}" if isinstance(value, float) else f"{name}={value}" for name, value in values.items()]


def _scale(resolution: float, signals: Signals, axis: str) -> Fraction:
    """Counts of the signal with this reading in one of an encoder with this resolution in m; negative if they turn the
    sign over. Of a float it is not used."""
    signal = signals.signals[axis]
    if signal.is_float:
        return Fraction(1)
    step = signal.scale * signals.factors[axis]
    return Fraction(resolution / step).limit_denominator(_LARGEST_DENOMINATOR)


class BoardProgram:
    """The running program and its machine.

    Args:
        can: names the program, board_posix or another build of it, and the bus.
        arguments: see :func:`program_arguments`.
        parameters, stage, guide: of the machine, as of :class:`~straightcomp_ros.hardware.simulated.SimulatedHardware`.

    Raises:
        HardwareError: the program cannot be started.
    """

    def __init__(
        self,
        can: CanParameters,
        arguments: Sequence[str],
        parameters: SimulatedParameters,
        stage: StageParameters,
        guide: StraightnessMap,
    ) -> None:
        # What acts when, the hold and the command timeout are the firmware's.
        bare = dataclasses.replace(parameters, command_timeout=1.0, hold_after=1e6)
        self.machine = SimulatedHardware(bare, stage, guide)
        wire = can.make_wire()
        self._emulator = EmulatorFrames(can.node, wire)
        self.stage = StageReceiver(self._emulator)
        self._encoder, self._code_current = stage.encoder, stage.drive.current_step
        self._truth_id = self._emulator.truth_id if can.simulated_stage and can.fd else 0
        self._name, self._started = can.firmware, False
        self.socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [can.firmware, f"machine={theirs.fileno()}", *arguments]
            try:
                self._process = subprocess.Popen(command, pass_fds=[theirs.fileno()])
            except OSError as error:
                self.socket.close()
                raise HardwareError(f"firmware '{can.firmware}' cannot be started: {error.strerror}") from error

    def serve(self, stopped: Callable[[], bool], hub: Hub | None = None) -> None:
        """Be the machine of a program that is on a bus, and the bus too if it is a ``hub`` of this process.

        It ends with ``stopped()``, which is called ten times a second at least; raises HardwareError if the program
        ends before.
        """
        if hub is not None:
            hub.watch(self.socket.fileno(), self._answer_next)
            hub.run(stopped)
            return
        self.socket.settimeout(0.1)
        while not stopped():
            with contextlib.suppress(TimeoutError):
                self._answer_next()

    def _answer_next(self) -> None:
        self.answer(self.receive())

    def receive(self) -> bytes:
        """The next packet; raises HardwareError if the program has ended."""
        try:
            packet = self.socket.recv(_LONGEST)
        except ConnectionResetError:
            # It ended before it had read what was sent to it.
            packet = b""
        if not packet:
            code = self._process.wait(_END_S)
            raise HardwareError(f"firmware '{self._name}' has ended with code {code}")
        return packet

    def send(self, packet: bytes) -> None:
        """Send a packet; whether the program has ended, :meth:`receive` finds."""
        with contextlib.suppress(BrokenPipeError):
            self.socket.send(packet)

    def answer(self, packet: bytes) -> None:
        """Do what a packet of the program asks of the machine."""
        kind, machine = packet[:1], self.machine
        if kind == b"S":
            _, at_ns, counter = _SAMPLE.unpack(packet)
            self.send(self._reading(at_ns, counter))
        elif kind == b"D":
            _, at_ns, on, code = _DRIVE.unpack(packet)
            if on:
                machine.enable()
                machine.write(code * self._code_current, at_ns)
            else:
                machine.disable()
        elif kind == b"G":
            _, at_ns, identifier = _STAGE.unpack_from(packet)
            self.stage.obey(identifier, packet[_STAGE.size :], machine, at_ns)

    def _reading(self, at_ns: int, counter: int) -> bytes:
        machine = self.machine
        if not self._started:
            machine.start(at_ns)
            self._started = True
        ((sample, truth),) = machine.read(at_ns)
        x, y = round(sample.x / self._encoder.x_resolution), round(sample.y / self._encoder.y_resolution)
        current = 0.0 if math.isnan(sample.current) else sample.current
        reading = _READING.pack(x, y, current, True, self._truth_id)
        return reading + self._emulator.truth_payload(counter, truth) if self._truth_id else reading

    def close(self) -> None:
        """End the program, which switches its amplifier off."""
        self.socket.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.machine.close()


class FirmwareBoard:
    """The program in lockstep, as :class:`~straightcomp_ros.hardware.can.board.Board` is the emulator: frames go out
    through ``send`` and come in through :meth:`receive`, at times that the caller passes in."""

    def __init__(
        self,
        can: CanParameters,
        parameters: SimulatedParameters,
        stage: StageParameters,
        guide: StraightnessMap,
        send: Callable[[int, bytes, bool], None],
        now_ns: int,
    ) -> None:
        arguments = program_arguments(can, parameters, stage, bus="", lead_ns=0)
        self._board = BoardProgram(can, arguments, parameters, stage, guide)
        self._send = send
        self._command_ids = {frames.identifier for frames in can.make_wire().commands}
        self.machine = self._board.machine
        self._call(_TICK.pack(b"T", now_ns))

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
        self.amplifier, self.fault = Amplifier(amplifier), BoardFault(fault)

    @property
    def refused_trajectory(self) -> str:
        """Why the last trajectory of the stage was refused."""
        return self._board.stage.refused

    def close(self) -> None:
        """End the program."""
        self._board.close()
