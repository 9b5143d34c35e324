"""Frames that only an emulated board uses: a trajectory for its stage, and the simulation's truth.

A real stage moves by its own controller; the emulator's stage has to be commanded. Each waypoint takes two frames; a
last frame with a checksum starts the motion. These are classic frames on either kind of bus. The truth of a sample
comes right before it, on CAN FD only: it fills the longest frame there is. config/emulator.dbc describes them.
"""

import struct
import zlib
from collections.abc import Sequence

from straightcomp_ros.hardware.can.board_dbc import Wire
from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID, Dbc
from straightcomp_ros.hardware.can.frames import FrameError, Frames
from straightcomp_ros.hardware.interface import Hardware, HardwareError, Truth
from straightcomp_ros.model.motion import Trajectory, Waypoint
from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.parameters.declaration import ParameterError

FILE = "config/emulator.dbc"
_POINTS = "Points"


class EmulatorFrames:
    """These frames for the board ``node`` on ``wire``.

    Raises:
        ParameterError: the wire has a frame with an identifier of these.
    """

    def __init__(self, node: int, wire: Wire) -> None:
        dbc = Dbc(FILE)
        found: list[Frames] = []
        taken = {*wire.identifiers, *(frames.identifier for frames in wire.commands)}
        for name in ("StageTime", "StageMotion", "StageStart", "StagePace", "Truth"):
            message = dbc.message(name)
            identifier = dbc.identifier(message, node)
            if identifier in taken:
                raise ParameterError(
                    f"parameter 'can.simulated_stage': {wire.dbc.file} has a frame {identifier & ~EXTENDED_ID:#x} of "
                    f"its own, which is the emulator's '{name}'; allowed: false, or another 'can.node'"
                )
            signals = {signal.name: signal for signal in message.signals}
            physical = {name: 1.0 for name, signal in signals.items() if signal.unit or signal.scale != 1.0}
            found.append(Frames(message, identifier, signals, physical))
        self._time, self._motion, self._start, self._pace, self._truth = found
        self.stage = {frames.identifier: frames for frames in found[:4]}
        """The frames of a trajectory and of its pace, by identifier."""
        self.truth_id = self._truth.identifier
        crc = self._truth.fields["TruthCrc"]
        self._content = (crc.start + crc.length) // 8
        self._most_points = int(self._start.fields[_POINTS].maximum or 0)

    def stage_payloads(self, waypoints: Sequence[Waypoint]) -> list[tuple[int, bytes]]:
        """Identifier and payload of each frame that moves a simulated stage, in the order of sending.

        Raises:
            HardwareError: too many points, or one that does not fit its frame.
        """
        most = self._most_points
        if len(waypoints) > most:
            raise HardwareError(f"stage trajectory has {len(waypoints)} points; allowed over CAN: <= {most}")
        frames = []
        for number, point in enumerate(waypoints):
            try:
                frames.append((self._time.identifier, self._time.pack((number, point.time_ns))))
                motion = self._motion.pack((number, point.position, point.velocity))
                frames.append((self._motion.identifier, motion))
            except ValueError as error:
                raise HardwareError(f"stage trajectory, point {number}: {error}") from None
        seal = zlib.crc32(b"".join(payload for _, payload in frames))
        return [*frames, (self._start.identifier, self._start.pack((len(waypoints), seal)))]

    def home_payload(self) -> tuple[int, bytes]:
        """Identifier and payload of the frame that references x: it starts a motion without points."""
        return self._start.identifier, self._start.pack((0, zlib.crc32(b"")))

    def pace_payload(self, pace: Pace) -> tuple[int, bytes]:
        """Identifier and payload of the frame that asks for a pace; it has its own checksum."""
        numbers = pace.override, int(pace.hold), int(pace.end)
        return self._pace.identifier, self._pace.pack((*numbers, _seal_of_pace(numbers)))

    def truth_payload(self, counter: int, truth: Truth) -> bytes:
        """The counter of the sample, CRC-32 of the rest with the counter as start value, and the truth."""
        pack = self._truth.pack
        seal = zlib.crc32(pack((counter, 0, *truth))[self._content :], counter)
        return pack((counter, seal, *truth))

    def truth_of(self, payload: bytes) -> tuple[int, Truth]:
        """Sample counter and truth; raises FrameError if the frame is damaged."""
        try:
            counter, seal, *numbers = self._truth.unpack(payload)
        except FrameError:
            raise FrameError("truth") from None
        if seal != zlib.crc32(payload[self._content :], counter):
            raise FrameError("truth")
        return counter, Truth(*numbers)


def _seal_of_pace(numbers: tuple[float, int, int]) -> int:
    override, hold, end = numbers
    return zlib.crc32(struct.pack("<IBB", round(override * 1e4), hold, end))


class StageReceiver:
    """Collects the frames of :meth:`EmulatorFrames.stage_payloads` on the simulated machine's side."""

    refused = ""
    """Why the last trajectory was refused."""

    def __init__(self, frames: EmulatorFrames) -> None:
        self._frames = frames.stage
        self._pace_id, self._home = frames.pace_payload(Pace())[0], frames.home_payload()
        self._points = self._empty()

    def _empty(self) -> dict[int, dict[int, tuple[bytes, tuple[int | float, ...]]]]:
        """Payload and values of times and motions by their numbers."""
        time_id, motion_id, *_ = self._frames
        return {time_id: {}, motion_id: {}}

    def obey(self, identifier: int, payload: bytes, machine: Hardware, at_ns: int) -> None:
        """Take one frame, and move ``machine`` from ``at_ns`` on with the one that starts the motion."""
        try:
            if identifier == self._pace_id and len(payload) == self._frames[identifier].size:
                override, hold, end, seal = self._frames[identifier].unpack(payload)
                if seal != _seal_of_pace((override, int(hold), int(end))):
                    raise HardwareError("the frame of a pace is damaged")
                machine.pace(Pace(float(override), bool(hold), bool(end)))
                return
            if (identifier, payload) == self._home:
                machine.home(at_ns)
                return
            trajectory = self.add(identifier, payload)
            if trajectory is not None:
                machine.move(trajectory, at_ns)
        except (HardwareError, ValueError) as error:
            self.refused = str(error)

    def add(self, identifier: int, payload: bytes) -> Trajectory | None:
        """Take one frame; return the trajectory with the frame that starts the motion.

        Raises:
            HardwareError: frames before it were lost or damaged.
            ValueError: the points make no trajectory.
        """
        frames = self._frames.get(identifier)
        if frames is None or len(payload) != frames.size:
            return None
        number, *values = frames.unpack(payload)
        if identifier in self._points:
            self._points[identifier][number] = payload, tuple(values)
            return None
        (times, motions), self._points = self._points.values(), self._empty()
        refused = f"stage trajectory of {number} points is refused"
        try:
            points = [(times[k], motions[k]) for k in range(number)]
        except KeyError as error:
            raise HardwareError(f"{refused}: frames of it are missing") from error
        if [zlib.crc32(b"".join(sent for point in points for sent, _ in point))] != values:
            raise HardwareError(f"{refused}: its CRC-32 is wrong")
        return Trajectory([Waypoint(int(time[0]), *motion) for (_, time), (_, motion) in points])
