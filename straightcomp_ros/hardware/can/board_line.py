"""The emulated board's connection to its bus: any interface of python-can, or a hub in the board's own process.

Neither blocks. With the hub in its own process, no other process has to wake up between board and host.
"""

import contextlib
import sys
import time

import can

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.hub import NO_DATA, Hub, address, addressed, from_packet, to_packet
from straightcomp_ros.hardware.can.hub_bus import frame_of, message_of
from straightcomp_ros.hardware.can.link import is_down, opened_bus

_AT_ONCE = 64
_REOPEN_EVERY_S = 0.1

Received = tuple[int, bytes, int]
"""A frame: identifier, payload, system time in ns at which it was on the bus."""


class BusLine:
    """A bus of python-can, which is opened again after a loss."""

    def __init__(self, parameters: CanParameters) -> None:
        self._parameters = parameters
        self._bus: can.BusABC | None = None
        self._next_open_s = 0.0
        self._complained = ""
        self._open()

    def send(self, identifier: int, payload: bytes, fd: bool) -> bool:
        """Send a frame; False if the bus did not take it."""
        if self._bus is None:
            return False
        try:
            self._bus.send(message_of(addressed(identifier, payload, fd=fd)))
        except (can.CanError, OSError) as error:
            if is_down(error):
                self.close()
            return False
        return True

    def receive(self) -> list[Received]:
        """Frames since the last call, a bounded number."""
        if self._bus is None:
            self._open()
        frames: list[Received] = []
        try:
            while self._bus is not None and len(frames) < _AT_ONCE:
                message = self._bus.recv(0)
                if message is None:
                    break
                frame = frame_of(message)
                if not frame.flags & NO_DATA:
                    frames.append((address(frame), frame.data, frame.stamp_ns))
        except (can.CanError, OSError):
            self.close()
        return frames

    def close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(can.CanError, OSError):
                bus.shutdown()

    def _open(self) -> None:
        if time.monotonic() < self._next_open_s:
            return
        self._next_open_s = time.monotonic() + _REOPEN_EVERY_S
        try:
            self._bus = opened_bus(self._parameters)
            self._complained = ""
        except (can.CanError, OSError) as error:
            if str(error) != self._complained:
                self._complained = str(error)
                print(f"dsp_emulator: {error}", file=sys.stderr, flush=True)


class HubLine:
    """A hub in this process, on the socket ``path``, with the board as its member; raises as :class:`Hub` does."""

    def __init__(self, path: str) -> None:
        self._packets: list[bytes] = []
        self._hub = Hub(path, member=self._packets.append)

    def send(self, identifier: int, payload: bytes, fd: bool) -> bool:
        """Send a frame; a node that does not read loses it silently."""
        self._hub.put(to_packet(addressed(identifier, payload, fd=fd, stamp_ns=time.time_ns())))
        return True

    def receive(self) -> list[Received]:
        """Frames since the last call, a bounded number."""
        self._hub.serve(0)
        frames = [from_packet(packet) for packet in self._packets]
        self._packets.clear()
        return [(address(frame), frame.data, frame.stamp_ns) for frame in frames if not frame.flags & NO_DATA]

    def close(self) -> None:
        self._hub.close()


Line = BusLine | HubLine
