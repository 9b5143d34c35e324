"""The hub: takes packets from each node of its bus and passes them to all others, with injected faults if asked for.

A SOCK_SEQPACKET socket keeps packets whole and in order, and shows when a node is gone. A node that does not read loses
frames; the others go on. Frames take no time on this bus, and its nodes take turns, whatever the identifiers.
"""

import contextlib
import errno
import random
import select
import socket
import struct
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID
from straightcomp_ros.hardware.interface import HardwareError

FLOOD = 20
"""Frames that a babbling node sends before each of ours."""
_FOREIGN = 0x7
_AT_ONCE = 16
"""Frames of a node before the others have their turn."""
_LONGEST_WAIT_S = 0.1
BUFFER = 1 << 20
"""Bytes that a socket of the bus holds for one that does not read."""
_HEAD = struct.Struct("<QIB")
LONGEST = _HEAD.size + 64

REMOTE, ERROR, FD, BIT_RATE_SWITCH = 2, 4, 8, 16
"""Flags of a frame: plain numbers, since each operation on an IntFlag takes some microseconds."""
FD_FRAME = FD | BIT_RATE_SWITCH
"""The frames of CAN FD that this package sends."""
NO_DATA = ERROR | REMOTE
"""A frame of either kind has no payload to use, whatever its identifier."""


class Frame(NamedTuple):
    """A frame on the bus; ``stamp_ns`` is the system time at which it was sent, ns since the epoch. EXTENDED_ID is set
    in an ``identifier`` of 29 bits."""

    stamp_ns: int
    identifier: int
    flags: int
    data: bytes


def to_packet(frame: Frame) -> bytes:
    return _HEAD.pack(*frame[:3]) + frame.data


def from_packet(packet: bytes) -> Frame:
    stamp_ns, identifier, flags = _HEAD.unpack_from(packet)
    return Frame(stamp_ns, identifier, flags, packet[_HEAD.size :])


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
        self._random = random.Random(seed)
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
            if self._random.random() < rate:
                if kind == "reorder":
                    self._held = frame
                    return []
                self.injected[kind] += 1
                return KINDS[kind](frame, self._random)
        return [frame]


def _corrupt(frame: Frame, chance: random.Random) -> list[Frame]:
    """One or two wrong bits: the most that the CRC promises to find."""
    bits = chance.sample(range(8 * len(frame.data)), min(chance.randint(1, 2), 8 * len(frame.data)))
    value = int.from_bytes(frame.data, "little")
    for bit in bits:
        value ^= 1 << bit
    return [frame._replace(data=value.to_bytes(len(frame.data), "little"))]


def _cut(frame: Frame, chance: random.Random) -> list[Frame]:
    raise LinkCut


KINDS: Mapping[str, Callable[[Frame, random.Random], list[Frame]]] = {
    "drop": lambda frame, _: [],
    "duplicate": lambda frame, _: [frame, frame],
    "reorder": lambda frame, _: [frame],  # Faults holds it until the next one
    "corrupt": _corrupt,
    # Any content: one in 256 passes the CRC.
    "garble": lambda frame, chance: [frame._replace(data=chance.randbytes(len(frame.data)))],
    "truncate": lambda frame, chance: [frame._replace(data=frame.data[: chance.randrange(len(frame.data) or 1)])],
    "wrong_id": lambda frame, chance: [frame._replace(identifier=frame.identifier ^ 1 << chance.randrange(11))],
    "error_frame": lambda frame, _: [Frame(frame.stamp_ns, 0x20, ERROR, bytes(8)), frame],
    # A request for the frame, which a bus has in the classic format alone.
    "remote": lambda frame, _: [frame._replace(flags=REMOTE, data=b""), frame],
    "flood": lambda frame, _: [frame._replace(identifier=frame.identifier & EXTENDED_ID | _FOREIGN)] * FLOOD + [frame],
    "cut": _cut,
}
"""Kinds of faults, and what each does to a frame."""


class Hub:
    """A bus on a socket file; :meth:`run` serves it.

    Args:
        path: of the socket, made here and removed by :meth:`close`.
        fault: ``fault(frame)`` returns the frames that arrive in place of one, or raises :class:`LinkCut`.
        member: ``member(frame)`` gets the frames for a node in the hub's own process, which uses this object as it
            would use a :class:`~straightcomp_ros.hardware.can.link.Link`.

    Raises:
        HardwareError: the socket cannot be made, or another hub listens on it.
    """

    passed = 0
    """Frames received."""
    dropped = 0
    """Frames that a node did not get because its buffer was full."""
    cuts = 0
    """How often the link was cut."""
    problem = ""
    """Of the member's connection, which has none."""

    def __init__(
        self,
        path: str | Path,
        fault: Callable[[Frame], list[Frame]] | None = None,
        member: Callable[[Frame], object] | None = None,
    ) -> None:
        self._path, self._fault, self._member = Path(path), fault, member
        self._readable = select.poll()
        self._calls: dict[int, Callable[[], object]] = {}
        """What is to be done when a descriptor can be read."""
        self._nodes: list[socket.socket] = []
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._bind()
        except OSError as error:
            self._listener.close()
            raise HardwareError(f"hub: socket '{path}': {error.strerror or error}") from error
        self._listener.listen()
        self._listener.setblocking(False)
        self.watch(self._listener.fileno(), self._accept)

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
            self.wait(_LONGEST_WAIT_S)

    def watch(self, descriptor: int, call: Callable[[], object]) -> None:
        """Call ``call()`` in :meth:`wait` whenever a descriptor of the hub's process can be read."""
        self._calls[descriptor] = call
        self._readable.register(descriptor, select.POLLIN)

    def wait(self, timeout_s: float) -> None:
        """Pass on a bounded number of frames, waiting up to ``timeout_s`` for the first."""
        for descriptor, _ in self._readable.poll(round(1e3 * timeout_s)):
            # A node may have gone meanwhile.
            if descriptor in self._calls:
                self._calls[descriptor]()

    def send(self, identifier: int, payload: bytes, *, fd: bool) -> bool:
        """Pass a frame of the ``member`` to all others; a node that does not read loses it silently."""
        self._pass_on(None, to_packet(Frame(time.time_ns(), identifier, FD_FRAME if fd else 0, payload)))
        return True

    def cut(self) -> None:
        """Cut the link: every node loses its connection, and may connect again."""
        self.cuts += 1
        self._forget(*self._nodes)

    def close(self) -> None:
        self._forget(*self._nodes)
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        node, _ = self._listener.accept()
        node.setblocking(False)
        node.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
        self._nodes.append(node)
        self.watch(node.fileno(), partial(self._fetch, node))

    def _forget(self, *nodes: socket.socket) -> None:
        for node in nodes:
            self._readable.unregister(node)
            del self._calls[node.fileno()]
            self._nodes.remove(node)
            with contextlib.suppress(OSError):
                node.shutdown(socket.SHUT_RDWR)
            node.close()

    def _fetch(self, node: socket.socket) -> None:
        """Pass on what a node has sent, up to :data:`_AT_ONCE` frames; a fault may cut its link meanwhile."""
        for _ in range(_AT_ONCE):
            if node not in self._nodes:
                return
            try:
                packet = node.recv(LONGEST)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self._forget(node)
                return
            self._pass_on(node, packet)

    def _pass_on(self, sender: socket.socket | None, packet: bytes) -> None:
        self.passed += 1
        packets = [packet]
        if self._fault is not None:
            try:
                packets = [to_packet(frame) for frame in self._fault(from_packet(packet))]
            except LinkCut:
                self.cut()
                return
        for arriving in packets:
            if self._member is not None and sender is not None:
                self._member(from_packet(arriving))
            for node in self._nodes:
                if node is not sender:
                    try:
                        node.send(arriving)
                    except BlockingIOError:
                        self.dropped += 1
                    except OSError:
                        pass  # it is gone, and wait() will remove it
