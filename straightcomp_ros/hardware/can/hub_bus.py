"""python-can's interface ``straightcomp_hub``: a bus between processes of one computer, where the kernel has no CAN.

The channel is the path of the hub's socket, see :mod:`straightcomp_ros.hardware.can.hub`. Frames of one sender arrive
in the order of sending; a receiver that does not keep up loses frames, as with an adapter.
"""

import contextlib
import select
import socket
import time
from typing import Any

import can

from straightcomp_ros.hardware.can import hub
from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID
from straightcomp_ros.hardware.can.hub import Frame

INTERFACE = "straightcomp_hub"
_BITS = {
    "is_remote_frame": hub.REMOTE,
    "is_error_frame": hub.ERROR,
    "is_fd": hub.FD,
    "bitrate_switch": hub.BIT_RATE_SWITCH,
}


class HubBus(can.BusABC):
    """One node on the bus of the hub whose socket is ``channel``; ``can_filters`` are applied in this process.

    Raises:
        can.CanInitializationError: no hub listens there.
    """

    def __init__(self, channel: str, can_filters: Any = None, fd: bool = False, **options: Any) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, hub.BUFFER)
        try:
            self._socket.connect(str(channel))
        except OSError as error:
            self._socket.close()
            raise can.CanInitializationError(f"no hub at '{channel}': {error.strerror}") from error
        self._socket.setblocking(False)
        self.channel_info = f"hub {channel}"
        super().__init__(channel=channel, can_filters=can_filters, **options)
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20

    def recv_frame(self, timeout: float | None) -> Frame | None:
        """The next frame, unfiltered, or None after ``timeout`` s; raises can.CanOperationError if the hub is gone.

        It is without the cost of python-can's message.
        """
        # poll() takes no times below a millisecond.
        if timeout != 0.0 and not select.select([self._socket], [], [], timeout)[0]:
            return None
        try:
            packet = self._socket.recv(hub.LONGEST)
        except BlockingIOError:
            return None
        except OSError as error:
            raise can.CanOperationError(f"hub: {error.strerror}") from error
        if not packet:
            raise can.CanOperationError("the hub closed the connection")
        return hub.from_packet(packet)

    def send_frame(self, identifier: int, flags: int, data: bytes) -> None:
        """Hand a frame to the hub as :meth:`send` does, without waiting and without python-can's message."""
        try:
            self._socket.send(hub.to_packet(Frame(time.time_ns(), identifier, flags, data)))
        except BlockingIOError as error:
            raise can.CanOperationError("transmit buffer full") from error
        except OSError as error:
            raise can.CanOperationError(f"hub: {error.strerror}") from error

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand a frame to the hub; its stamp is the time of this call.

        Raises can.CanOperationError if the buffer is full for ``timeout`` s (None: at once), or the hub is gone.
        """
        if timeout and self.fileno() >= 0:
            select.select([], [self._socket], [], timeout)
        self.send_frame(*frame_of(msg)[1:])

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        frame = self.recv_frame(timeout)
        # An error frame has no identifier and passes the filters, as with socketcan.
        return (message_of(frame), bool(frame.flags & hub.ERROR)) if frame else (None, False)

    def shutdown(self) -> None:
        super().shutdown()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def fileno(self) -> int:
        return self._socket.fileno()


def frame_of(message: can.Message) -> Frame:
    identifier = message.arbitration_id | (EXTENDED_ID if message.is_extended_id else 0)
    flags = sum(bit for name, bit in _BITS.items() if getattr(message, name))
    return Frame(round(message.timestamp * 1e9), identifier, flags, bytes(message.data))


def message_of(frame: Frame) -> can.Message:
    stamp_ns, identifier, flags, data = frame
    own, extended = identifier & ~EXTENDED_ID, bool(identifier & EXTENDED_ID)
    kinds = {name: bool(flags & bit) for name, bit in _BITS.items()}
    return can.Message(stamp_ns * 1e-9, own, is_extended_id=extended, data=data, **kinds)
