"""The hub: takes packets from each node of its bus and passes them to all others, with injected faults if asked for.

A SOCK_SEQPACKET socket keeps packets whole and in order, and shows when a node is gone. A node that does not read loses
frames; the others go on. Of each node's oldest waiting frame, the one of highest priority goes first, as on a bus.
Frames take no time on this bus.
"""

import contextlib
import enum
import errno
import random
import select
import socket
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID
from straightcomp_ros.hardware.interface import HardwareError

FLOOD = 20
"""Frames that a babbling node sends before each of ours."""
_FOREIGN_ID = 0x7
_AT_ONCE = 16
"""Frames between two polls of the sockets."""
_LONGEST_WAIT_MS = 100
_BUFFER = 1 << 20
_HEAD = struct.Struct("<QIB")
LONGEST = _HEAD.size + 64


class Flag(enum.IntFlag):
    """Kind of a frame."""

    EXTENDED = 1
    REMOTE = 2
    ERROR = 4
    FD = 8
    BIT_RATE_SWITCH = 16


# Plain numbers, since each operation on an IntFlag takes some microseconds. FD_FRAME is what this package sends.
EXTENDED, REMOTE, ERROR = int(Flag.EXTENDED), int(Flag.REMOTE), int(Flag.ERROR)
FD_FRAME = int(Flag.FD | Flag.BIT_RATE_SWITCH)
NO_DATA = ERROR | REMOTE
"""A frame of either kind has no payload to use, whatever its identifier."""


class Frame(NamedTuple):
    """A frame on the bus; ``stamp_ns`` is the system time at which it was sent, ns since the epoch."""

    stamp_ns: int
    identifier: int
    flags: int
    data: bytes


def address(frame: Frame) -> int:
    """Identifier of a frame, with EXTENDED_ID set in one of 29 bits."""
    return frame.identifier | EXTENDED_ID if frame.flags & EXTENDED else frame.identifier


def addressed(address: int, payload: bytes, *, fd: bool, stamp_ns: int = 0) -> Frame:
    """The frame to an :func:`address`."""
    extended = EXTENDED if address & EXTENDED_ID else 0
    return Frame(stamp_ns, address & ~EXTENDED_ID, extended | (FD_FRAME if fd else 0), payload)


def to_packet(frame: Frame) -> bytes:
    return _HEAD.pack(*frame[:3]) + frame.data


def from_packet(packet: bytes) -> Frame:
    stamp_ns, identifier, flags = _HEAD.unpack_from(packet)
    return Frame(stamp_ns, identifier, flags, packet[_HEAD.size :])


def priority(packet: bytes) -> tuple[int, int, int]:
    """Sort key by which frames win the bus, the lowest first: by the bits of the identifier."""
    _, identifier, flags = _HEAD.unpack_from(packet)
    if flags & EXTENDED:
        # After eleven equal bits a standard frame wins.
        return identifier >> 18, 1, identifier & 0x3FFFF
    return identifier, 0, 0


class LinkCut(Exception):
    """All nodes lose their connection to the bus."""


class Faults:
    """``faults(frame)``: the frames that arrive in place of one that was sent.

    A frame suffers one fault at most. ``rates`` are probabilities per frame, by kind; ``injected`` counts the faults.

    Raises:
        ValueError: a kind is unknown, or its rate is not between 0 and 1.
    """

    def __init__(self, rates: Mapping[str, float], seed: int = 0) -> None:
        for kind, rate in rates.items():
            if kind not in KINDS:
                raise ValueError(f"fault '{kind}' is unknown; allowed: {', '.join(KINDS)}")
            if not 0.0 <= rate <= 1.0:
                raise ValueError(f"fault '{kind}': rate of {rate} is not allowed; allowed: 0 to 1")
        self._rates = dict(rates)
        self.random = random.Random(seed)
        self._held: Frame | None = None
        self.injected = dict.fromkeys(rates, 0)

    def __call__(self, frame: Frame) -> list[Frame]:
        """The frames that arrive; raises LinkCut where the link is cut."""
        held, self._held = self._held, None
        if held is not None:
            # Only frames with one identifier share a counter, so only these are swapped.
            if held.identifier == frame.identifier:
                self.injected["reorder"] += 1
                return [frame, held]
            return [held, *self(frame)]
        for kind, rate in self._rates.items():
            if self.random.random() < rate:
                frames = KINDS[kind](self, frame)
                if kind != "reorder":
                    self.injected[kind] += 1
                return frames
        return [frame]

    def _reorder(self, frame: Frame) -> list[Frame]:
        self._held = frame
        return []

    def _corrupt(self, frame: Frame) -> list[Frame]:
        """One or two wrong bits: the most that the CRC promises to find."""
        bits = self.random.sample(range(8 * len(frame.data)), min(self.random.randint(1, 2), 8 * len(frame.data)))
        value = int.from_bytes(frame.data, "little")
        for bit in bits:
            value ^= 1 << bit
        return [frame._replace(data=value.to_bytes(len(frame.data), "little"))]

    def _cut(self, _: Frame) -> list[Frame]:
        self.injected["cut"] += 1
        raise LinkCut


KINDS: Mapping[str, Callable[[Faults, Frame], list[Frame]]] = {
    "drop": lambda faults, frame: [],
    "duplicate": lambda faults, frame: [frame, frame],
    "reorder": Faults._reorder,
    "corrupt": Faults._corrupt,
    # Any content: one in 256 passes the CRC.
    "garble": lambda faults, frame: [frame._replace(data=faults.random.randbytes(len(frame.data)))],
    "truncate": lambda faults, frame: [frame._replace(data=frame.data[: faults.random.randrange(len(frame.data))])],
    "wrong_id": lambda faults, frame: [frame._replace(identifier=frame.identifier ^ 1 << faults.random.randrange(11))],
    "error_frame": lambda faults, frame: [Frame(frame.stamp_ns, 0x20, Flag.ERROR, bytes(8)), frame],
    # A request for the frame, which a bus has in the classic format alone.
    "remote": lambda faults, frame: [frame._replace(flags=frame.flags & EXTENDED | REMOTE, data=b""), frame],
    "flood": lambda faults, frame: [frame._replace(identifier=_FOREIGN_ID)] * FLOOD + [frame],
    "cut": Faults._cut,
}
"""Kinds of faults, and what each does to a frame."""


class Hub:
    """A bus on a socket file; :meth:`run` serves it.

    Args:
        path: of the socket, made here and removed by :meth:`close`.
        fault: ``fault(frame)`` returns the frames that arrive in place of one, or raises :class:`LinkCut`.
        member: ``member(packet)`` gets the frames for a node in the hub's own process, which sends by :meth:`put`.

    Raises:
        HardwareError: the socket cannot be made, or another hub listens on it.
    """

    passed = 0
    """Frames received."""
    dropped = 0
    """Frames that a node did not get because its buffer was full."""
    cuts = 0
    """How often the link was cut."""

    def __init__(
        self,
        path: str | Path,
        fault: Callable[[Frame], list[Frame]] | None = None,
        member: Callable[[bytes], object] | None = None,
    ) -> None:
        self._path = Path(path)
        self._fault = fault
        self._member = member
        self._readable = select.poll()
        self._nodes: dict[int, socket.socket] = {}
        self._watched: dict[int, Callable[[], object]] = {}
        self._waiting: dict[socket.socket, bytes] = {}
        """The oldest unsent frame of each node that has one."""
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._bind()
        except OSError as error:
            self._listener.close()
            raise HardwareError(f"hub: socket '{path}': {error.strerror or error}") from error
        self._listener.listen()
        self._listener.setblocking(False)
        self._readable.register(self._listener, select.POLLIN)

    def _bind(self) -> None:
        if self._path.is_socket():
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
                # Otherwise it was left by a hub that was killed.
                if probe.connect_ex(str(self._path)) != errno.ECONNREFUSED:
                    raise HardwareError(f"hub: another one listens on '{self._path}'")
            self._path.unlink()
        self._listener.bind(str(self._path))

    def run(self, stopped: Callable[[], bool]) -> None:
        """Serve until ``stopped()``, which is called at least ten times a second."""
        while not stopped():
            self.serve(_LONGEST_WAIT_MS)

    def watch(self, descriptor: int, call: Callable[[], object]) -> None:
        """Call ``call()`` in :meth:`serve` whenever a descriptor of the hub's process can be read."""
        self._watched[descriptor] = call
        self._readable.register(descriptor, select.POLLIN)

    def serve(self, timeout_ms: int) -> None:
        """Pass on a bounded number of frames, waiting up to ``timeout_ms`` for the first."""
        waiting, nodes, listener = self._waiting, self._nodes, self._listener.fileno()
        for descriptor, _ in self._readable.poll(0 if waiting else timeout_ms):
            if descriptor == listener:
                self._accept()
            elif descriptor in self._watched:
                self._watched[descriptor]()
            elif descriptor in nodes and nodes[descriptor] not in waiting:
                # Otherwise it is gone, or its frame waits already.
                self._fetch(nodes[descriptor])
        for _ in range(_AT_ONCE):
            if not waiting:
                break
            sender = next(iter(waiting)) if len(waiting) == 1 else min(waiting, key=lambda n: priority(waiting[n]))
            self._pass_on(sender, waiting.pop(sender))
            self._fetch(sender)

    def put(self, packet: bytes) -> None:
        """Pass a frame of the ``member`` to all others."""
        self._pass_on(None, packet)

    def cut(self) -> None:
        """Cut the link: every node loses its connection, and may connect again."""
        self.cuts += 1
        self._forget(*self._nodes.values())

    def close(self) -> None:
        self._forget(*self._nodes.values())
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        node, _ = self._listener.accept()
        node.setblocking(False)
        node.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._nodes[node.fileno()] = node
        self._readable.register(node, select.POLLIN)

    def _forget(self, *nodes: socket.socket) -> None:
        for node in nodes:
            self._readable.unregister(node)
            del self._nodes[node.fileno()]
            self._waiting.pop(node, None)
            with contextlib.suppress(OSError):
                node.shutdown(socket.SHUT_RDWR)
            node.close()

    def _fetch(self, node: socket.socket) -> None:
        try:
            packet = node.recv(LONGEST)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if packet:
            self._waiting[node] = packet
        elif node.fileno() in self._nodes:
            self._forget(node)

    def _pass_on(self, sender: socket.socket | None, packet: bytes) -> None:
        self.passed += 1
        packets = [packet]
        if self._fault is not None:
            try:
                packets = [to_packet(frame) for frame in self._fault(from_packet(packet))]
            except LinkCut:
                self.cut()
                return
        for packet in packets:
            if self._member is not None and sender is not None:
                self._member(packet)
            for node in self._nodes.values():
                if node is not sender:
                    self._send(node, packet)

    def _send(self, node: socket.socket, packet: bytes) -> None:
        try:
            node.send(packet)
        except BlockingIOError:
            self.dropped += 1
        except OSError:
            # It is gone, and serve() will remove it.
            pass
