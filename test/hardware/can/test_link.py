"""The bus as the driver reads it: what is let through, when it came, how much at once, and a bus that fails."""

import errno
import time

import can
import pytest

from straightcomp_ros.hardware.can import link as link_module
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID
from straightcomp_ros.hardware.can.hub import ERROR, EXTENDED, FD_FRAME, REMOTE, Frame, address, addressed
from straightcomp_ros.hardware.can.hub_bus import frame_of, message_of
from straightcomp_ros.hardware.can.link import Link, filter_of

OURS = 0x181


class Bus:
    """What python-can's bus does, from a list: messages, and errors to raise."""

    def __init__(self):
        self.coming, self.sent, self.shut = [], [], 0

    def recv(self, timeout):
        if not self.coming:
            return None
        if isinstance(self.coming[0], Exception):
            raise self.coming.pop(0)
        return message_of(self.coming.pop(0))

    def send(self, message, timeout):
        if self.sent is None:
            raise can.CanOperationError("transmit queue full")
        self.sent.append(message)

    def shutdown(self):
        self.shut += 1


class World:
    """A link on buses from a list; the host's clock runs ten seconds ahead of the system's."""

    def __init__(self, monkeypatch, buses):
        self.buses, self.arrived = list(buses), []
        monkeypatch.setattr(link_module, "opened_bus", self._open)
        self.link = Link(CanParameters(interface="virtual", fd=True), [OURS], self._receive, self.clock)

    def _open(self, parameters, filters):
        self.filters = filters
        bus = self.buses.pop(0)
        if isinstance(bus, Exception):
            raise bus
        return bus

    def _receive(self, frame, arrival_ns):
        self.arrived.append((frame, arrival_ns))

    @staticmethod
    def clock():
        return time.time_ns() + 10_000_000_000

    def opened(self, times=1):
        end = time.monotonic() + 60.0
        while self.link.openings < times:
            assert time.monotonic() < end, self.link.problem
            self.link.wait(0.001)
        return self


@pytest.fixture
def world(monkeypatch):
    worlds = []

    def make(*buses):
        worlds.append(World(monkeypatch, buses))
        worlds[-1].link.start()
        return worlds[-1]

    yield make
    for made in worlds:
        made.link.close()


def frame(identifier=OURS, flags=0, data=b"\1", ago_ns=0):
    return Frame(time.time_ns() - ago_ns, identifier, flags, data)


def test_only_the_boards_frames_and_error_frames_come_through(world):
    bus = Bus()
    host = world(bus).opened()
    bus.coming = [
        frame(0x182),
        frame(OURS, EXTENDED),
        frame(OURS, FD_FRAME),
        frame(OURS, REMOTE, b""),
        frame(0x20000004, ERROR | EXTENDED, bytes(8)),
    ]
    assert host.link.wait(0.0) == 5
    assert [one.flags for one, _ in host.arrived] == [FD_FRAME, REMOTE, ERROR | EXTENDED]
    assert host.filters == [{"can_id": OURS, "can_mask": 0x7FF, "extended": False}]


def test_an_identifier_of_29_bits_is_sent_and_filtered_as_such():
    wide, short = 0x18FF0201 | EXTENDED_ID, 0x201
    assert filter_of(wide) == {"can_id": 0x18FF0201, "can_mask": 0x1FFFFFFF, "extended": True}
    assert filter_of(short) == {"can_id": 0x201, "can_mask": 0x7FF, "extended": False}
    for identifier, flags in ((wide, EXTENDED), (short, 0)):
        for fd in (False, True):
            frame = addressed(identifier, b"\1", fd=fd, stamp_ns=7)
            assert frame == Frame(7, identifier & 0x1FFFFFFF, flags | (FD_FRAME if fd else 0), b"\1")
            assert address(frame) == address(frame_of(message_of(frame))) == identifier


@pytest.mark.parametrize(("ago_ns", "told"), [(4_000_000_000, True), (6_000_000_000, False), (-(10**9), False)])
def test_an_arrival_is_the_adapters_time_if_that_is_the_systems_and_else_now(world, ago_ns, told):
    bus = Bus()
    host = world(bus).opened()
    bus.coming = [frame(ago_ns=ago_ns)]
    host.link.wait(0.0)
    ((_, arrival_ns),) = host.arrived
    assert arrival_ns == pytest.approx(host.clock() - (ago_ns if told else 0), abs=1e9)


def test_a_babbling_node_is_read_in_portions(world):
    bus = Bus()
    host = world(bus).opened()
    bus.coming = [frame(data=bytes([number % 256])) for number in range(600)]
    portions = [host.link.wait(0.0) for _ in range(4)]
    assert portions == [256, 256, 88, 0]
    assert host.link.overloads == 2
    assert [one.data[0] for one, _ in host.arrived] == [number % 256 for number in range(600)]


def test_what_the_bus_does_not_take_is_counted_and_what_it_takes_is_not(world):
    bus = Bus()
    host = world(bus).opened()
    assert host.link.send(0x201, b"\1\2", fd=False) and host.link.send(0x301, b"\3", fd=True)
    classic, fd = bus.sent
    assert (classic.arbitration_id, bytes(classic.data), classic.is_fd) == (0x201, b"\1\2", False)
    assert (fd.arbitration_id, bytes(fd.data), fd.is_fd) == (0x301, b"\3", True)
    assert host.link.transmit_full == 0
    bus.sent = None
    assert not host.link.send(0x201, b"", fd=False)
    assert host.link.transmit_full == 1 and not host.link.problem


def test_an_interface_that_sending_finds_down_is_closed_named_and_opened_again(world):
    first = Bus()

    def send(message, timeout):
        # As python-can's SocketCAN; reading is not told again.
        raise can.CanOperationError("Failed to transmit: Network is down") from OSError(errno.ENETDOWN, "down")

    first.send = send
    host = world(first, Bus()).opened()
    assert not host.link.send(0x201, b"", fd=False)
    assert host.link.transmit_full == 1 and first.shut == 1
    assert host.link.problem == "CAN virtual can0: Failed to transmit: Network is down"
    host.opened(2)
    assert host.link.send(0x201, b"", fd=False) and host.link.problem == ""


def test_a_bus_that_fails_is_closed_named_and_opened_again(world):
    first, second = Bus(), Bus()
    host = world(first, second).opened()
    assert host.link.problem == ""
    first.coming = [OSError("the adapter was pulled out")]
    assert host.link.wait(0.0) == 0
    assert host.link.problem == "CAN virtual can0: the adapter was pulled out" and first.shut == 1
    assert not host.link.send(0x201, b"", fd=False)
    host.opened(2)
    second.coming = [frame()]
    assert host.link.wait(0.0) == 1 and host.link.problem == ""


def test_the_time_to_the_next_opening_doubles_up_to_a_second_and_is_short_again_after_a_frame(world, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(link_module.time, "monotonic", lambda: now[0])
    bus = Bus()
    host = world(*[OSError("no adapter")] * 9, bus, OSError("once more"))
    waits = []
    for left in range(9, -1, -1):
        end = time.perf_counter() + 60.0
        while len(host.buses) > left + 1 or host.link._opener.is_alive():
            assert time.perf_counter() < end
            time.sleep(0.001)
        if host.link.openings:
            break
        waits.append(host.link._next_opening_s - now[0])
        host.link.wait(0.0)
        # Not a moment before its time.
        assert len(host.buses) == left + 1
        now[0] = host.link._next_opening_s
        host.link.wait(0.0)
    assert waits == pytest.approx([0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.0, 1.0, 1.0])
    bus.coming = [OSError("opened, but down")]
    host.link.wait(0.0)
    assert host.link._next_opening_s - now[0] == pytest.approx(1.0)
    host.link._bus = bus
    bus.coming = [frame(), OSError("gone")]
    host.link.wait(0.0)
    assert host.link._next_opening_s - now[0] == pytest.approx(0.02)


def test_to_start_again_opens_the_bus_anew(world):
    first, second = Bus(), Bus()
    host = world(first, second).opened()
    host.link.start()
    assert first.shut == 1
    host.opened(2)
    assert host.link.problem == "" and second.shut == 0


def test_a_bus_that_opens_after_the_close_is_shut_again(world, monkeypatch):
    bus = Bus()
    host = world(OSError("later"), bus)
    host.link._opener.join()
    host.link.close()
    host.link._open()
    assert bus.shut == 1 and host.link._bus is None
