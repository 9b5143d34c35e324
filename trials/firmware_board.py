"""The program of the firmware core in lockstep: this process has bus and time, so that a run repeats to the bit."""

import struct
from collections.abc import Callable

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator import BoardProgram, program_arguments
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault
from straightcomp_ros.hardware.simulated import SimulatedParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap

_TICK, _RECEIVE, _FRAME = struct.Struct("=cq"), struct.Struct("=cqI"), struct.Struct("=cBI")
_DONE = struct.Struct("=cBBBIII")
"""Packets as firmware/posix/machine.h names them."""


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
        arguments = program_arguments(can, parameters, stage, bus="", lead_ns=0)
        self._board = BoardProgram(can, arguments, parameters, stage, guide)
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
        self.amplifier, self.fault = Amplifier(amplifier), BoardFault(fault)

    def close(self) -> None:
        """End the program."""
        self._board.close()
