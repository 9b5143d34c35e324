"""Emulated boards on the simulated machine: the board's behaviour in Python, and the firmware core as a program.

:class:`Board` has neither bus nor process: frames go out through the caller's function and come in through its
``receive()``; times are of the board's own clock, in ns, and passed in by the caller.

The program is that of firmware/posix, with the simulated machine behind its encoders and amplifier. It and this process
exchange packets over a socket, whose layouts firmware/posix/machine.h names. On a bus the program keeps the time, and
this process only answers what the encoders read; in lockstep (trials/can.py) it has the time too.
"""

import contextlib
import dataclasses
import math
import os
import socket
import struct
import subprocess
from collections.abc import Callable
from fractions import Fraction

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frames import BoardFault, Command, FrameError, Frames, Report
from straightcomp_ros.hardware.can.hub import Hub
from straightcomp_ros.hardware.can.sample_numbers import FrameSets
from straightcomp_ros.hardware.interface import HardwareError, Sample, State, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap

_BAD_FRAME, _ERROR_LIMIT = 4, 16
_COUNTED = 2**32
"""Modulus of what the emulator counts: the count in a frame is its remainder."""
_SHARE_OF_ECHO = 0.8
"""Of what an echo can distinguish: beyond that an old sample may as well be a future one."""

_LONGEST = 256
_SAMPLE, _DRIVE, _STAGE = (struct.Struct(layout) for layout in ("=cqI", "=cqBi", "=cqI"))
_READING = struct.Struct("=iidBI")
_VALID, _REFERENCED = 1, 2
_LARGEST_DENOMINATOR = 2**20
_END_S = 2.0


class Board:
    """Takes samples, obeys commands, switches off by itself, from :meth:`start` on.

    ``send(identifier, payload, fd)`` sends a frame; the others are of the driver and of its machine.

    Raises:
        ParameterError: see :class:`EmulatorFrames`.
    """

    refused_commands = 0
    """Commands that failed a check, were repeated or came too late."""
    counter = 0
    """Number of the newest sample."""
    command_alive: int | None = None
    """Of the last command that passed its checks."""

    def __init__(
        self,
        can: CanParameters,
        parameters: SimulatedParameters,
        stage: StageParameters,
        guide: StraightnessMap,
        send: Callable[[int, bytes, bool], None],
    ) -> None:
        self._wire = wire = can.make_wire()
        self._range, self._send = stage.drive.current_range, send
        self.machine = machine = SimulatedHardware(parameters, stage, guide)
        self.stage = EmulatorFrames(wire)
        self._sends_truth = can.simulated_stage and can.fd
        self._commands = {frames.identifier: (number, frames) for number, frames in enumerate(wire.commands)}
        self.identifiers = [*self._commands, *self.stage.orders]
        # An answer to a sample older than the timeout counts as no answer.
        oldest = machine.command_timeout_ns // machine.period_ns
        self._oldest_echo = min(oldest, int(_SHARE_OF_ECHO * wire.echo_modulus)) if wire.echo_modulus else 0
        self._fault, self._seen_off, self._error_counter = BoardFault.NONE, False, 0
        self._sent = dict.fromkeys(wire.reports, 0)
        self._sets: FrameSets[Command] = FrameSets(len(wire.commands), wire.command_modulus, machine.period_ns)

    def start(self, now_ns: int) -> None:
        """Begin, with the first sample at this time."""
        self._start_ns = self._newest_ns = self._next_heartbeat_ns = now_ns
        self.machine.start(now_ns)
        self._beat(self._wire.meaning.heartbeat.boot_up_value)

    def cycle(self, now_ns: int) -> None:
        """Take and send the samples up to ``now_ns``."""
        for sample, truth in self.machine.read(now_ns):
            self._send_sample(sample, truth)
        heartbeat = self._wire.heartbeat
        if heartbeat and now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + round(heartbeat.period * 1e9)
            self._beat(self._wire.meaning.heartbeat.operational_value)

    def receive(self, identifier: int, payload: bytes, at_ns: int) -> None:
        """Take a frame that arrived at ``at_ns``."""
        try:
            if identifier in self._commands:
                self._take(*self._commands[identifier], payload, at_ns)
            else:
                self.stage.obey(identifier, payload, self.machine, at_ns)
        except FrameError:
            self.refused_commands += 1
            self._error_counter = min(self._error_counter + _BAD_FRAME, _ERROR_LIMIT)
            if self._error_counter == _ERROR_LIMIT:
                self._trip(BoardFault.COMMAND_CHECK)

    def close(self) -> None:
        """Amplifier off."""
        self.machine.close()

    @property
    def amplifier(self) -> State:
        """The state that the next sample reports."""
        return State.FAULT if self._fault else self.machine.state

    @property
    def fault(self) -> BoardFault:
        """Why the amplifier is off."""
        return self._fault or (BoardFault.COMMAND_TIMEOUT if self.machine.state is State.FAULT else BoardFault.NONE)

    def _trip(self, fault: BoardFault) -> None:
        if self.machine.state is State.ON:
            self._fault = fault
        self.machine.disable()
        self._seen_off = False

    def _take(self, number: int, frames: Frames, payload: bytes, at_ns: int) -> None:
        """Take a command, or a component of one whose other signals come in other messages."""
        command = frames.unpack(payload)
        if command.enable is False:
            # "Off" is obeyed from any frame that passes its CRC, even an old one, or one whose others do not come.
            self._seen_off = True
            self.machine.disable()
        if len(self._commands) > 1:
            repeated = self._sets.repeated
            whole = self._sets.add(number, command, command.alive or 0, at_ns)
            self.refused_commands += self._sets.repeated - repeated
            if whole is None:
                return
            command, _ = whole
        self._obey(command, at_ns)

    def _obey(self, command: Command, at_ns: int) -> None:
        # Without a signal for it, each "off" resets.
        if not command.enable and command.reset is not False:
            self.machine.reset_fault()
            self._fault, self._error_counter = BoardFault.NONE, 0
        repeated = command.alive is not None and command.alive == self.command_alive
        self.command_alive = command.alive
        age = 0 if command.echo is None else (self.counter - command.echo) % self._wire.echo_modulus
        if repeated or age > self._oldest_echo:
            self.refused_commands += 1
            return
        self._error_counter = max(0, self._error_counter - 1)
        current = command.current or 0.0
        if not abs(current) <= self._range:
            self._trip(BoardFault.CURRENT_RANGE)
            return
        if command.enable and self._seen_off and self.amplifier is State.OFF:
            # Only an edge from off to on switches on, so a host that goes on saying "on" after a fault has no effect.
            self.machine.enable()
        self._seen_off = self._seen_off and not command.enable
        self.machine.write(current, at_ns, self._newest_ns - age * self.machine.period_ns)

    def _beat(self, state: int) -> None:
        if heartbeat := self._wire.heartbeat:
            self._send(heartbeat.identifier, heartbeat.pack((state,)), heartbeat.fd)

    def _send_sample(self, sample: Sample, truth: Truth) -> None:
        wire = self._wire
        self._newest_ns = sample.stamp_ns
        number = round((sample.stamp_ns - self._start_ns) / self.machine.period_ns)
        self.counter = number % (wire.number_modulus or _COUNTED)
        y = _within(sample.y, wire.homes["y"].spans["y"])
        x = sample.x if wire.sample.wraps else _within(sample.x, wire.sample.spans["x"])
        referenced = not self.machine.unreferenced
        if not referenced and self.machine.state is State.ON:
            # A wrong x must not be compensated for the time until the host has seen it.
            self._trip(BoardFault.ENCODER)
        current = 0.0 if math.isnan(sample.current) else sample.current
        report = Report(
            counter=self.counter,
            x=x,
            y=y,
            current=_within(current, wire.current.spans["current"]) if wire.current else None,
            amplifier=self.amplifier,
            fault=wire.fault_codes[self.fault],
            good=(x, y) == (sample.x, sample.y),
            referenced=referenced,
        )
        if self._sends_truth:
            self._send(self.stage.truth_id, self.stage.truth_payload(self.counter, truth), True)
        for frames in wire.reports.values():
            if number % frames.every == 0:
                turn = self._sent[frames.identifier]
                self._sent[frames.identifier] = turn + 1
                payload = frames.pack(report._replace(alive=turn % frames.alive_modulus), turn)
                self._send(frames.identifier, payload, frames.fd)


def _within(value: float, span: tuple[float, float]) -> float:
    return min(max(value, span[0]), span[1])


def program_arguments(can: CanParameters, parameters: SimulatedParameters, stage: StageParameters) -> list[str]:
    """Arguments of the program, NAME=VALUE, that say what board it is, and on what stage."""
    drive, encoder, hold = stage.drive, stage.encoder, parameters.hold(stage)
    wire = can.make_wire()
    x, y = (
        _scale(own, wire.homes[name], name) for own, name in ((encoder.x_resolution, "x"), (encoder.y_resolution, "y"))
    )
    values = {
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


def _scale(resolution: float, frames: Frames, axis: str) -> Fraction:
    """Counts of the signal with this reading in one of an encoder with this resolution in m; negative if they turn the
    sign over. Of a float it is not used."""
    signal = frames.fields[axis]
    if signal.is_float:
        return Fraction(1)
    step = signal.scale * frames.factors[axis]
    return Fraction(resolution / step).limit_denominator(_LARGEST_DENOMINATOR)


class BoardProgram:
    """The running program and its machine.

    Args:
        can: names the program, board_posix or another build of it.
        parameters, stage, guide: of the machine, as of :class:`~straightcomp_ros.hardware.simulated.SimulatedHardware`.
        bus: on which it is, as it names it; empty in lockstep.
        lead_ns: time in which this process wakes up and simulates.

    Raises:
        HardwareError: the program cannot be started.
    """

    def __init__(
        self,
        can: CanParameters,
        parameters: SimulatedParameters,
        stage: StageParameters,
        guide: StraightnessMap,
        bus: str = "",
        lead_ns: int = 0,
    ) -> None:
        # What acts when, the hold and the command timeout are the firmware's.
        bare = dataclasses.replace(parameters, command_timeout=1.0, hold_after=1e6)
        self.machine = SimulatedHardware(bare, stage, guide)
        self.stage = EmulatorFrames(can.make_wire())
        self._encoder, self._code_current = stage.encoder, stage.drive.current_step
        self._truth_id = self.stage.truth_id if can.simulated_stage and can.fd else 0
        self._name, self._started = can.firmware, False
        self.socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            program = os.path.abspath(os.path.expanduser(can.firmware))  # no name to look for in PATH
            command = [program, f"machine={theirs.fileno()}", f"bus={bus}", f"lead_ns={lead_ns}"]
            command += program_arguments(can, parameters, stage)
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
            hub.watch(self.socket.fileno(), lambda: self.answer(self.receive()))
            hub.run(stopped)
            return
        self.socket.settimeout(0.1)
        while not stopped():
            with contextlib.suppress(TimeoutError):
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
        reading = _READING.pack(x, y, current, _VALID | _REFERENCED * (not machine.unreferenced), self._truth_id)
        return reading + self.stage.truth_payload(counter, truth) if self._truth_id else reading

    def close(self) -> None:
        """End the program, which switches its amplifier off."""
        self.socket.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.machine.close()
