"""The hub: takes packets from each node of its bus and hands them to all others, through faults if asked for.

A SOCK_SEQPACKET socket keeps packets whole and in order, and shows when a node is gone. A node that does not fetch
its frames loses them; the others go on.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
from collections.abc import Callable
from pathlib import Path

from straightcomp_ros.hardware.can.faults import LinkCut
from straightcomp_ros.hardware.can.hub_packet import LONGEST, Frame, from_packet, to_packet
from straightcomp_ros.hardware.interface import HardwareError

_AT_ONCE = 64
_BUFFER = 1 << 20

FaultHook = Callable[[Frame], list[Frame]]


class Hub:
    """A bus on a socket file; :meth:`run` serves it.

    Args:
        path: of the socket, made here and removed by :meth:`close`.
        fault: ``fault(frame)`` gives the frames that arrive in the place of one, or raises
            :class:`~straightcomp_ros.hardware.can.faults.LinkCut`.

    Raises:
        HardwareError: the socket cannot be made, or another hub listens on it.
    """

    def __init__(self, path: str | Path, fault: FaultHook | None = None) -> None:
        self._path = Path(path)
        self._fault = fault
        self.passed = 0
        """Frames that came in."""
        self.dropped = 0
        """Frames that a node did not get because its buffer was full."""
        self.cuts = 0
        """Times that the link was cut."""
        self._selector = selectors.DefaultSelector()
        self._nodes: list[socket.socket] = []
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._bind()
        except OSError as error:
            self._listener.close()
            raise HardwareError(f"hub: socket '{path}': {error.strerror or error}") from error
        self._listener.listen()
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)

    def _bind(self) -> None:
        if self._path.is_socket():
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
                if probe.connect_ex(str(self._path)) == 0:
                    raise HardwareError(f"hub: another one listens on '{self._path}'")
            # Left by a hub that was killed.
            self._path.unlink()
        self._listener.bind(str(self._path))

    def run(self, stopped: Callable[[], bool]) -> None:
        """Serve until ``stopped()``, which is asked ten times a second at least."""
        while not stopped():
            for key, _ in self._selector.select(timeout=0.1):
                if key.fileobj is self._listener:
                    self._accept()
                elif isinstance(key.fileobj, socket.socket) and key.fileobj.fileno() >= 0:
                    self._serve(key.fileobj)

    def cut(self) -> None:
        """Cut the link: every node loses its connection, and may connect again."""
        self.cuts += 1
        for node in list(self._nodes):
            self._forget(node)

    def close(self) -> None:
        """End the bus."""
        for node in list(self._nodes):
            self._forget(node)
        self._selector.close()
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        node, _ = self._listener.accept()
        node.setblocking(False)
        node.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._nodes.append(node)
        self._selector.register(node, selectors.EVENT_READ)

    def _forget(self, node: socket.socket) -> None:
        self._selector.unregister(node)
        self._nodes.remove(node)
        with contextlib.suppress(OSError):
            node.shutdown(socket.SHUT_RDWR)
        node.close()

    def _serve(self, sender: socket.socket) -> None:
        for _ in range(_AT_ONCE):
            try:
                packet = sender.recv(LONGEST)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self._forget(sender)
                return
            self.passed += 1
            try:
                packets = [packet] if self._fault is None else map(to_packet, self._fault(from_packet(packet)))
            except LinkCut:
                self.cut()
                return
            for arriving in packets:
                self._spread(sender, arriving)

    def _spread(self, sender: socket.socket, packet: bytes) -> None:
        for node in self._nodes:
            if node is not sender:
                try:
                    node.send(packet)
                except BlockingIOError:
                    self.dropped += 1
                except OSError:
                    # It has gone; its own turn to be served removes it.
                    continue
