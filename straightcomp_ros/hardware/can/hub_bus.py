"""python-can's interface ``straightcomp_hub``: a bus between processes of one computer, where the kernel has no CAN.

The channel is the path of the hub's socket, see :mod:`straightcomp_ros.hardware.can.hub`. Frames of one sender arrive
in the order in which they were sent; a receiver that does not keep up loses frames, as with an adapter.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
from typing import Any

import can

from straightcomp_ros.hardware.can.hub_packet import LONGEST, Flag, Frame, from_packet, to_packet

INTERFACE = "straightcomp_hub"
_BUFFER = 1 << 20


class HubBus(can.BusABC):
    """One node on the hub's bus.

    Args:
        channel: path of the hub's socket.
        can_filters: as in python-can; applied in this process.
        fd: whether frames of CAN FD may be sent.

    Raises:
        can.CanInitializationError: nobody listens there.
    """

    def __init__(self, channel: str, can_filters: Any = None, fd: bool = False, **options: Any) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        try:
            self._socket.connect(str(channel))
        except OSError as error:
            self._socket.close()
            raise can.CanInitializationError(f"no hub at '{channel}': {error.strerror}") from error
        self._socket.setblocking(False)
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)
        self.channel_info = f"hub {channel}"
        super().__init__(channel=channel, can_filters=can_filters, **options)
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            packet = self._socket.recv(LONGEST)
        except BlockingIOError:
            if timeout == 0.0 or not self._readable.poll(None if timeout is None else max(1, round(timeout * 1e3))):
                return None, False
            try:
                packet = self._socket.recv(LONGEST)
            except BlockingIOError:
                return None, False
            except OSError as error:
                raise can.CanOperationError(f"hub: {error.strerror}") from error
        except OSError as error:
            raise can.CanOperationError(f"hub: {error.strerror}") from error
        if not packet:
            raise can.CanOperationError("the hub closed the connection")
        message = _message(from_packet(packet))
        # Filters are for identifiers, and an error frame has none: it passes, as with socketcan.
        return message, message.is_error_frame

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand a frame to the hub; its stamp is the time of this call.

        Raises:
            can.CanOperationError: the socket's buffer is full for ``timeout`` seconds (not waiting, if None), or
                the hub is gone.
        """
        packet = to_packet(Frame(time.time_ns(), msg.arbitration_id, _flags(msg), bytes(msg.data)))
        try:
            self._socket.send(packet)
        except BlockingIOError as error:
            if timeout and select.select([], [self._socket], [], timeout)[1]:
                self.send(msg)
                return
            raise can.CanOperationError("transmit buffer full") from error
        except OSError as error:
            raise can.CanOperationError(f"hub: {error.strerror}") from error

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def fileno(self) -> int:
        """File descriptor of the socket."""
        return self._socket.fileno()


def _flags(message: can.Message) -> int:
    return (
        message.is_extended_id * Flag.EXTENDED
        | message.is_remote_frame * Flag.REMOTE
        | message.is_error_frame * Flag.ERROR
        | message.is_fd * Flag.FD
        | message.bitrate_switch * Flag.BIT_RATE_SWITCH
    )


def _message(frame: Frame) -> can.Message:
    flags = frame.flags
    return can.Message(
        timestamp=frame.stamp_ns * 1e-9,
        arbitration_id=frame.identifier,
        is_extended_id=bool(flags & Flag.EXTENDED),
        is_remote_frame=bool(flags & Flag.REMOTE),
        is_error_frame=bool(flags & Flag.ERROR),
        is_fd=bool(flags & Flag.FD),
        bitrate_switch=bool(flags & Flag.BIT_RATE_SWITCH),
        data=frame.data,
    )
