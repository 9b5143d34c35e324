"""Frames that only an emulated board uses: a trajectory for its stage, and the simulation's truth.

A real stage moves by its own controller; the emulator's stage has to be commanded. Each waypoint takes two frames; a
last frame with a checksum starts the motion. These are classic frames on either kind of bus. The truth of a sample
comes right before it, on CAN FD only: it fills the longest frame there is. config/emulator.dbc describes them.
"""

import zlib
from collections.abc import Sequence

from straightcomp_ros.hardware.can.board_dbc import Wire
from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID, Dbc
from straightcomp_ros.hardware.can.frames import FrameError, Frames
from straightcomp_ros.hardware.interface import Hardware, HardwareError, Truth
from straightcomp_ros.model.motion import Trajectory, Waypoint
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
        self._frames: dict[str, Frames] = {}
        taken = {*wire.identifiers, *(frames.identifier for frames in wire.commands)}
        for name in ("StageTime", "StageMotion", "StageStart", "Truth"):
            message = dbc.message(name)
            identifier = dbc.identifier(message, node)
            if identifier in taken:
                raise ParameterError(
                    f"parameter 'can.simulated_stage': {wire.dbc.file} has a frame {identifier & ~EXTENDED_ID:#x} of "
                    f"its own, which is the emulator's '{name}'; allowed: false, or another 'can.node'"
                )
            signals = {signal.name: signal for signal in message.signals}
            physical = {name: 1.0 for name, signal in signals.items() if signal.unit}
            self._frames[name] = Frames(message, identifier, signals, physical)
        self._time, self._motion, self._start, self._truth = self._frames.values()
        self.truth_id = self._truth.identifier
        self.stage_ids = [one.identifier for one in (self._time, self._motion, self._start)]
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

    def unpack(self, identifier: int, payload: bytes) -> tuple[str, tuple[int | float, ...]] | None:
        """Message and values of one of the stage's frames; None for any other."""
        for name, frames in self._frames.items():
            if identifier == frames.identifier and frames is not self._truth and len(payload) == frames.size:
                return name, frames.unpack(payload)
        return None

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


class StageReceiver:
    """Collects the frames of :meth:`EmulatorFrames.stage_payloads` on the simulated machine's side."""

    refused = ""
    """Why the last trajectory was refused."""

    def __init__(self, frames: EmulatorFrames) -> None:
        self._frames = frames
        self._points: dict[str, dict[int, tuple[bytes, tuple[int | float, ...]]]] = {}
        self._forget()

    def obey(self, identifier: int, payload: bytes, machine: Hardware, at_ns: int) -> None:
        """Take one frame, and move ``machine`` from ``at_ns`` on with the one that starts the motion."""
        try:
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
        found = self._frames.unpack(identifier, payload)
        if found is None:
            return None
        name, (number, *values) = found
        if name in self._points:
            self._points[name][int(number)] = payload, tuple(values)
            return None
        return self._trajectory(int(number), int(values[0]))

    def _forget(self) -> None:
        self._points = {"StageTime": {}, "StageMotion": {}}

    def _trajectory(self, points: int, seal: int) -> Trajectory:
        times, motions = self._points.values()
        self._forget()
        try:
            frames = [(times[number], motions[number]) for number in range(points)]
        except KeyError as error:
            raise HardwareError(f"stage trajectory of {points} points is refused: frames of it are missing") from error
        if zlib.crc32(b"".join(payload for frame in frames for payload, _ in frame)) != seal:
            raise HardwareError(f"stage trajectory of {points} points is refused: its CRC-32 is wrong")
        return Trajectory([Waypoint(int(time[0]), *motion) for (_, time), (_, motion) in frames])
