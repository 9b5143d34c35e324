"""Frames that only an emulated board uses: a trajectory for its stage, and the simulation's truth.

A real stage moves by its own controller; the emulator's stage has to be commanded. Each waypoint takes two frames; a
last frame with a checksum starts the motion. These are classic frames on either kind of bus. The truth of a sample
comes right before it, on CAN FD only: it fills the longest frame there is. config/emulator.dbc describes them.
"""

import zlib
from collections.abc import Sequence

from straightcomp_ros.hardware.can.board_dbc import Wire
from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID, Dbc
from straightcomp_ros.hardware.can.frames import Crc, FrameError, Frames
from straightcomp_ros.hardware.interface import Hardware, HardwareError, Truth
from straightcomp_ros.model.motion import Trajectory, Waypoint
from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.parameters.declaration import ParameterError

FILE = "config/emulator.dbc"
_SEALED = {"StagePace": "PaceCrc", "Truth": "TruthCrc"}
"""By message the signal with a CRC-32 of the rest."""


class EmulatorFrames:
    """These frames for the board of ``wire``: the host packs them, the simulated machine's side obeys them.

    Raises:
        ParameterError: the wire has a frame with an identifier of these.
    """

    refused = ""
    """Why the last trajectory was refused."""

    def __init__(self, wire: Wire) -> None:
        dbc = Dbc(FILE)
        found: list[Frames] = []
        taken = {*wire.identifiers, *(frames.identifier for frames in wire.commands)}
        for name in ("StageTime", "StageMotion", "StageStart", "StagePace", "Truth"):
            message = dbc.message(name)
            identifier = dbc.identifier(message, wire.node)
            if identifier in taken:
                raise ParameterError(
                    f"parameter 'can.simulated_stage': {wire.dbc.file} has a frame {identifier & ~EXTENDED_ID:#x} of "
                    f"its own, which is the emulator's '{name}'; allowed: false, or another 'can.node'"
                )
            signals = {signal.name: signal for signal in message.signals}
            crc = Crc(message, signals.pop(_SEALED[name]), None, "crc_32", []) if name in _SEALED else None
            physical = {name: 1.0 for name, signal in signals.items() if signal.unit or signal.scale != 1.0}
            found.append(Frames(message, identifier, signals, physical, crc=crc))
        self.time, self.motion, self.start, self.pace, self._truth = found
        self.orders = {frames.identifier: frames for frames in found[:4]}
        """The frames of a trajectory and of its pace, by identifier."""
        self.truth_id = self._truth.identifier
        self._came: dict[tuple[int, int], bytes] = {}
        """Payloads of times and motions by identifier and number of the point."""

    def stage_payloads(self, waypoints: Sequence[Waypoint]) -> list[tuple[int, bytes]]:
        """Identifier and payload of each frame that moves a simulated stage, in the order of sending; without points it
        is homed.

        Raises:
            HardwareError: too many points, or one that does not fit its frame.
        """
        most = int(self.start.fields["Points"].maximum or 0)
        if len(waypoints) > most:
            raise HardwareError(f"stage trajectory has {len(waypoints)} points; allowed over CAN: <= {most}")
        frames = []
        for number, point in enumerate(waypoints):
            try:
                frames.append((self.time.identifier, self.time.pack((number, point.time_ns))))
                motion = self.motion.pack((number, point.position, point.velocity))
                frames.append((self.motion.identifier, motion))
            except ValueError as error:
                raise HardwareError(f"stage trajectory, point {number}: {error}") from None
        seal = zlib.crc32(b"".join(payload for _, payload in frames))
        return [*frames, (self.start.identifier, self.start.pack((len(waypoints), seal)))]

    def pace_payload(self, pace: Pace) -> tuple[int, bytes]:
        """Identifier and payload of the frame that asks for a pace."""
        return self.pace.identifier, self.pace.pack((pace.override, int(pace.hold), int(pace.end)))

    def truth_payload(self, counter: int, truth: Truth) -> bytes:
        """The truth with the counter of its sample."""
        return self._truth.pack((counter, *truth))

    def truth_of(self, payload: bytes) -> tuple[int, Truth]:
        """Sample counter and truth; raises FrameError if the frame is damaged."""
        counter, *numbers = self._truth.unpack(payload)
        return counter, Truth(*numbers)

    def obey(self, identifier: int, payload: bytes, machine: Hardware, at_ns: int) -> None:
        """Take one frame, and move ``machine`` from ``at_ns`` on with the one that starts the motion."""
        frames = self.orders.get(identifier)
        if frames is None:
            return
        try:
            number, *values = frames.unpack(payload)
            if frames is self.pace:
                hold, end = values
                machine.pace(Pace(float(number), bool(hold), bool(end)))
            elif frames is not self.start:
                self._came[identifier, number] = payload
            elif points := self._gathered(number, *values):
                machine.move(Trajectory(points), at_ns)
            else:
                machine.home(at_ns)
        except FrameError as error:
            self.refused = f"a frame of '{frames.name}' is damaged ({error})"
        except (HardwareError, ValueError) as error:
            self.refused = str(error)

    def _gathered(self, number: int, seal: int) -> list[Waypoint]:
        """The points that came; HardwareError if frames of them were lost or damaged."""
        came, self._came = self._came, {}
        refused = f"stage trajectory of {number} points is refused"
        try:
            sent = [came[frames.identifier, k] for k in range(number) for frames in (self.time, self.motion)]
        except KeyError as error:
            raise HardwareError(f"{refused}: frames of it are missing") from error
        if zlib.crc32(b"".join(sent)) != seal:
            raise HardwareError(f"{refused}: its CRC-32 is wrong")
        times, motions = map(self.time.unpack, sent[::2]), map(self.motion.unpack, sent[1::2])
        return [Waypoint(int(time_ns), *motion) for (_, time_ns), (_, *motion) in zip(times, motions, strict=True)]
