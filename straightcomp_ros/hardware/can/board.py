"""An emulator of the board's firmware on the simulated machine, without bus and process.

Frames go out through the caller's function and come in through :meth:`Board.receive`. Times are of the board's own
clock, in ns, and passed in by the caller.
"""

import math
from collections.abc import Callable

from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames, StageReceiver
from straightcomp_ros.hardware.can.frame_sets import FrameSets
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault, Command, FrameError, Report
from straightcomp_ros.hardware.can.message_frames import CommandFrames, ReportFrames
from straightcomp_ros.hardware.can.wire import Wire
from straightcomp_ros.hardware.interface import Sample, State, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware

_STRIKE, _STRIKE_LIMIT = 4, 16
_COUNTED = 2**32
"""Modulus of what the emulator counts: the count in a frame is its remainder."""
_SHARE_OF_ECHO = 0.8
"""Of what an echo can tell apart: an older sample than that is not distinguished from a future one."""
_AMPLIFIER = {State.OFF: Amplifier.OFF, State.ON: Amplifier.ON, State.FAULT: Amplifier.FAULT}


class Board:
    """Takes samples, obeys commands, switches off by itself.

    ``machine`` is plant and stage, with the board's ``command_timeout``; ``current_range`` the largest control current
    in A that the board accepts; ``send(identifier, payload, fd)`` sends a frame; ``now_ns`` is the time of the first
    sample. ``emulator`` has the frames of a simulated stage, None for a board without; ``tells_truth`` sends the
    simulation's truth before each sample, which needs CAN FD.
    """

    refused_commands = 0
    """Commands that failed a check, were repeated or came too late."""

    def __init__(
        self,
        machine: SimulatedHardware,
        wire: Wire,
        current_range: float,
        send: Callable[[int, bytes, bool], None],
        now_ns: int,
        *,
        emulator: EmulatorFrames | None = None,
        tells_truth: bool = False,
    ) -> None:
        self.machine = machine
        self._wire = wire
        self._range = current_range
        self._send = send
        self._emulator, self._tells_truth = emulator, tells_truth and emulator is not None
        self._start_ns = now_ns
        # An answer to a sample older than the timeout counts as no answer.
        oldest = machine.command_timeout_ns // machine.period_ns
        self._oldest_echo = min(oldest, int(_SHARE_OF_ECHO * wire.echo_modulus)) if wire.echo_modulus else 0
        self._fault = BoardFault.NONE
        self._seen_off = False
        self.command_alive: int | None = None
        """Of the last command that passed its checks."""
        self.counter = 0
        """Number of the newest sample."""
        self._strikes = 0
        self._sent = dict.fromkeys(wire.reports, 0)
        self._commands = {frames.identifier: (part, frames) for part, frames in enumerate(wire.commands)}
        self._sets: FrameSets[Command] = FrameSets(len(wire.commands), wire.command_modulus, machine.period_ns)
        self._newest_ns = self._next_heartbeat_ns = now_ns
        self._stage = StageReceiver(emulator) if emulator else None
        machine.start(now_ns)
        if wire.heartbeat:
            self._beat(wire.heartbeat.boot_up)

    def cycle(self, now_ns: int) -> None:
        """Take and send the samples up to ``now_ns``."""
        for sample, truth in self.machine.read(now_ns):
            self._send_sample(sample, truth)
        heartbeat = self._wire.heartbeat
        if heartbeat and now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + round(heartbeat.period * 1e9)
            self._beat(heartbeat.operational)

    def receive(self, identifier: int, payload: bytes, at_ns: int) -> None:
        """Take a frame that arrived at ``at_ns``."""
        try:
            if identifier in self._commands:
                self._hear(*self._commands[identifier], payload, at_ns)
            elif self._stage:
                self._stage.obey(identifier, payload, self.machine, at_ns)
        except FrameError:
            self._strike()

    def close(self) -> None:
        """Amplifier off."""
        self.machine.close()

    @property
    def refused_trajectory(self) -> str:
        """Why the last trajectory of the stage was refused."""
        return self._stage.refused if self._stage else ""

    @property
    def amplifier(self) -> Amplifier:
        """The state that the next sample reports."""
        return Amplifier.FAULT if self._fault else _AMPLIFIER[self.machine.state]

    @property
    def fault(self) -> BoardFault:
        """Why the amplifier is off."""
        return self._fault or (BoardFault.COMMAND_TIMEOUT if self.machine.state is State.FAULT else BoardFault.NONE)

    def _strike(self) -> None:
        self.refused_commands += 1
        self._strikes = min(self._strikes + _STRIKE, _STRIKE_LIMIT)
        if self._strikes == _STRIKE_LIMIT:
            self._trip(BoardFault.COMMAND_CHECK)

    def _trip(self, fault: BoardFault) -> None:
        if self.machine.state is State.ON:
            self._fault = fault
        self.machine.disable()
        self._seen_off = False

    def _hear(self, part: int, frames: CommandFrames, payload: bytes, at_ns: int) -> None:
        """Take a command, or a part of one whose other signals come in other messages."""
        command = frames.unpack(payload)
        if command.enable is False:
            self._switch_off()
        if len(self._commands) == 1:
            self._obey(command, at_ns)
            return
        repeated = self._sets.repeated
        whole = self._sets.add(part, command, command.alive or 0, at_ns)
        self.refused_commands += self._sets.repeated - repeated
        if whole is not None:
            self._obey(whole[0], at_ns)

    def _switch_off(self) -> None:
        # "Off" is obeyed from any frame that passes its CRC, even an old one, or one whose others do not come.
        self._seen_off = True
        self.machine.disable()

    def _obey(self, command: Command, at_ns: int) -> None:
        # Without a signal for it, each "off" resets.
        if not command.enable and command.reset is not False:
            self.machine.reset_fault()
            self._fault, self._strikes = BoardFault.NONE, 0
        repeated = command.alive is not None and command.alive == self.command_alive
        self.command_alive = command.alive
        age = 0 if command.echo is None else (self.counter - command.echo) % self._wire.echo_modulus
        if repeated or age > self._oldest_echo:
            self.refused_commands += 1
            return
        self._strikes = max(0, self._strikes - 1)
        current = command.current or 0.0
        if not abs(current) <= self._range:
            self._trip(BoardFault.CURRENT_RANGE)
            return
        if command.enable and self._seen_off and self.amplifier is Amplifier.OFF:
            # Only an edge from off to on switches on, so a host that goes on saying "on" after a fault has no effect.
            self.machine.enable()
        self._seen_off = self._seen_off and not command.enable
        self.machine.write(current, at_ns, self._newest_ns - age * self.machine.period_ns)

    def _beat(self, state: int) -> None:
        heartbeat = self._wire.heartbeat
        if heartbeat:
            self._send(heartbeat.identifier, heartbeat.pack(state), heartbeat.fd)

    def _send_sample(self, sample: Sample, truth: Truth) -> None:
        wire = self._wire
        self._newest_ns = sample.stamp_ns
        number = round((sample.stamp_ns - self._start_ns) / self.machine.period_ns)
        self.counter = number % (wire.number_modulus or _COUNTED)
        x, y = (_within(value, wire.homes[name].spans[name]) for name, value in (("x", sample.x), ("y", sample.y)))
        report = Report(
            counter=self.counter,
            x=x,
            y=y,
            current=0.0 if math.isnan(sample.current) else sample.current,
            amplifier=self.amplifier,
            fault=wire.fault_codes[self.fault],
            good=(x, y) == (sample.x, sample.y),
        )
        if self._tells_truth and self._emulator:
            self._send(self._emulator.truth_id, self._emulator.truth_payload(self.counter, truth), True)
        for frames in wire.reports.values():
            if number % frames.every == 0:
                self._send_report(frames, report)

    def _send_report(self, frames: ReportFrames, report: Report) -> None:
        turn, span = self._sent[frames.identifier], frames.spans.get("current")
        self._sent[frames.identifier] = turn + 1
        report = report._replace(alive=turn % frames.alive_modulus)
        if span is not None and report.current is not None:
            report = report._replace(current=_within(report.current, span))
        self._send(frames.identifier, frames.pack(report, turn), frames.fd)


def _within(value: float, span: tuple[float, float]) -> float:
    return min(max(value, span[0]), span[1])
