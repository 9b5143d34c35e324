"""An emulator of the board's firmware on the simulated machine, without bus and process.

Frames go out through the caller's function and come in through :meth:`Board.receive`. Times are of the board's own
clock, in ns, and passed in by the caller.
"""

import math
from collections.abc import Callable

from straightcomp_ros.hardware.can import frames
from straightcomp_ros.hardware.can.budget import HEARTBEAT_PERIOD
from straightcomp_ros.hardware.can.emulator_frames import StageReceiver, truth_payload
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault, Codec, Switch
from straightcomp_ros.hardware.interface import HardwareError, Sample, State, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware

_STRIKE, _STRIKE_LIMIT = 4, 16
_OLDEST_ECHO = 200
"""Samples: the oldest that the eight bits of a classic frame distinguish from a future one."""
_PATTERNS = frozenset(Switch)
_AMPLIFIER = {State.OFF: Amplifier.OFF, State.ON: Amplifier.ON, State.FAULT: Amplifier.FAULT}


class Board:
    """Takes samples, obeys commands, switches off by itself.

    ``machine`` is plant and stage, with the board's ``command_timeout``; ``current_range`` the largest control current
    in A that the board accepts; ``send(identifier, payload, fd)`` sends a frame; ``now_ns`` is the time of the first
    sample. ``tells_truth`` sends the simulation's truth before each sample, on CAN FD only.
    """

    refused_commands = 0
    """Commands that failed a check, were repeated or came too late."""
    refused_trajectory = ""
    """Why the last trajectory of the stage was refused."""

    def __init__(
        self,
        machine: SimulatedHardware,
        codec: Codec,
        current_range: float,
        send: Callable[[int, bytes, bool], None],
        now_ns: int,
        *,
        tells_truth: bool = False,
    ) -> None:
        self.machine = machine
        self._codec = codec
        self._range = current_range
        self._send = send
        self._tells_truth = tells_truth and codec.fd
        self._start_ns = now_ns
        # An answer to a sample older than the timeout counts as no answer.
        oldest = machine.command_timeout_ns // machine.period_ns
        self._oldest_echo = oldest if codec.fd else min(oldest, _OLDEST_ECHO)
        self._fault = BoardFault.NONE
        self._seen_off = False
        self._command_alive: int | None = None
        self._strikes = self._counter = self._current_alive = 0
        self._newest_ns = self._next_heartbeat_ns = now_ns
        self._stage = StageReceiver(codec.ids)
        machine.start(now_ns)
        send(codec.ids.heartbeat, bytes((frames.BOOT_UP,)), False)

    def cycle(self, now_ns: int) -> None:
        """Take and send the samples up to ``now_ns``."""
        for sample, truth in self.machine.read(now_ns):
            self._send_sample(sample, truth)
        if now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + round(HEARTBEAT_PERIOD * 1e9)
            self._send(self._codec.ids.heartbeat, bytes((frames.OPERATIONAL,)), False)

    def receive(self, identifier: int, payload: bytes, at_ns: int) -> None:
        """Take a frame that arrived at ``at_ns``."""
        try:
            if identifier == self._codec.command_id:
                self._obey(self._codec.unpack_command(payload), at_ns)
            elif trajectory := self._stage.add(identifier, payload):
                self.machine.move(trajectory, at_ns)
        except frames.FrameError:
            self._strike()
        except (HardwareError, ValueError) as error:
            self.refused_trajectory = str(error)

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

    def _obey(self, command: frames.Command, at_ns: int) -> None:
        if not {command.enable, command.reset} <= _PATTERNS:
            raise frames.FrameError("pattern")
        if command.enable == Switch.NO:
            # "Off" is obeyed from any frame that passes its CRC, even an old one.
            self._seen_off = True
            self.machine.disable()
            if command.reset == Switch.YES:
                self.machine.reset_fault()
                self._fault, self._strikes = BoardFault.NONE, 0
        repeated = command.alive == self._command_alive
        self._command_alive = command.alive
        age = (self._counter - command.echo) % (frames.COUNTER_MODULUS if self._codec.fd else 256)
        if repeated or age > self._oldest_echo:
            self.refused_commands += 1
            return
        self._strikes = max(0, self._strikes - 1)
        current = command.current * frames.CURRENT_COUNT
        if abs(current) > self._range:
            self._trip(BoardFault.CURRENT_RANGE)
            return
        if command.enable == Switch.YES and self._seen_off and self.amplifier is Amplifier.OFF:
            # Only an edge from off to on switches on, so a host that goes on saying "on" after a fault has no effect.
            self.machine.enable()
        self._seen_off = self._seen_off and command.enable == Switch.NO
        self.machine.write(current, at_ns, self._newest_ns - age * self.machine.period_ns)

    def _send_sample(self, sample: Sample, truth: Truth) -> None:
        codec = self._codec
        self._newest_ns = sample.stamp_ns
        self._counter = round((sample.stamp_ns - self._start_ns) / self.machine.period_ns) % frames.COUNTER_MODULUS
        x, y = round(sample.x / frames.POSITION_COUNT), round(sample.y / frames.POSITION_COUNT)
        valid = abs(x) <= frames.X_LIMIT and abs(y) <= frames.Y_LIMIT
        current = 0 if math.isnan(sample.current) else round(sample.current / frames.CURRENT_COUNT)
        current = min(max(current, -frames.CURRENT_LIMIT), frames.CURRENT_LIMIT)
        status = frames.status_bits(self.amplifier, self.fault, valid)
        alive = self._counter % frames.ALIVE_MODULUS
        frame = frames.Encoder(alive, status, x if valid else 0, y if valid else 0, current, self._counter)
        if self._tells_truth:
            self._send(codec.ids.truth, truth_payload(self._counter, truth), True)
        self._send(codec.encoder_id, codec.pack_encoder(frame), codec.fd)
        if not codec.fd and self._counter % frames.CURRENT_EVERY == 0:
            coil_current = frames.Current(self._current_alive, current, self._counter)
            self._send(codec.ids.current, codec.pack_current(coil_current), False)
            self._current_alive = (self._current_alive + 1) % frames.ALIVE_MODULUS
