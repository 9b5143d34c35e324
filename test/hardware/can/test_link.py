"""Connections to the bus: what is let through, when it came, how much at once, and a bus that fails."""

import contextlib
import errno
import time
import types

import can
import pytest

from straightcomp_ros.hardware.can import link as link_module
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID
from straightcomp_ros.hardware.can.hub import ERROR, EXTENDED, FD_FRAME, REMOTE, Frame, address, addressed
from straightcomp_ros.hardware.can.hub_bus import frame_of, message_of
from straightcomp_ros.hardware.can.link import BusLine, Link, filter_of

OURS = 0x181


class Bus:
    """What python-can's bus does, from a list: frames, and errors to raise; ``refusal`` is that of sending."""

    def __init__(self, *coming):
        self.coming, self.sent, self.shut, self.refusal = list(coming), [], 0, None

    def recv(self, timeout):
        if not self.coming:
            return None
        if isinstance(self.coming[0], Exception):
            raise self.coming.pop(0)
        return message_of(self.coming.pop(0))

    def send(self, message, timeout=0):
        if self.refusal is not None:
            raise self.refusal
        self.sent.append(message)

    def shutdown(self):
        self.shut += 1
        raise can.CanOperationError("gone already")


def is_down():
    # As python-can's SocketCAN; who reads is not found again.
    error = can.CanOperationError("Failed to transmit: Network is down")
    error.__cause__ = OSError(errno.ENETDOWN, "down")
    return error


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
    with contextlib.ExitStack() as stack:

        def make(*buses):
            made = World(monkeypatch, buses)
            stack.callback(made.link.close)
            made.link.start()
            return made

        yield make


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


@pytest.mark.parametrize(("ago_ns", "used"), [(4_000_000_000, True), (6_000_000_000, False), (-(10**9), False)])
def test_an_arrival_is_the_adapters_time_if_that_is_the_systems_and_else_now(world, ago_ns, used):
    host = world(Bus(frame(ago_ns=ago_ns))).opened()
    host.link.wait(0.0)
    ((_, arrival_ns),) = host.arrived
    assert arrival_ns == pytest.approx(host.clock() - (ago_ns if used else 0), abs=1e9)


def test_a_babbling_node_is_read_in_portions(world):
    bus = Bus()
    host = world(bus).opened()
    bus.coming = [frame(data=bytes([number % 256])) for number in range(600)]
    assert [host.link.wait(0.0) for _ in range(4)] == [256, 256, 88, 0] and host.link.overloads == 2
    assert [one.data[0] for one, _ in host.arrived] == [number % 256 for number in range(600)]


def test_what_the_bus_does_not_take_is_counted_and_what_it_takes_is_not(world):
    bus = Bus()
    host = world(bus).opened()
    assert host.link.send(0x201, b"\1\2", fd=False) and host.link.send(0x301, b"\3", fd=True)
    sent = [(one.arbitration_id, bytes(one.data), one.is_fd) for one in bus.sent]
    assert sent == [(0x201, b"\1\2", False), (0x301, b"\3", True)] and host.link.transmit_full == 0
    bus.refusal = can.CanOperationError("transmit queue full")
    assert not host.link.send(0x201, b"", fd=False)
    assert host.link.transmit_full == 1 and not host.link.problem


@pytest.mark.parametrize("found_by", ["sending", "reading"])
def test_a_bus_that_fails_is_closed_named_and_opened_again(world, found_by):
    first, second = Bus(), Bus()
    host = world(first, second).opened()
    assert host.link.problem == ""
    if found_by == "sending":
        first.refusal = is_down()
        assert not host.link.send(0x201, b"", fd=False)
    else:
        first.coming = [OSError("Failed to transmit: Network is down")]
        assert host.link.wait(0.0) == 0
    assert first.shut == 1
    assert host.link.problem == "CAN virtual can0: Failed to transmit: Network is down"
    assert not host.link.send(0x201, b"", fd=False)
    host.opened(2)
    second.coming = [frame()]
    assert host.link.wait(0.0) == 1 and host.link.send(0x201, b"", fd=False) and host.link.problem == ""


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


def test_a_bus_that_opens_after_the_close_is_shut_again(world):
    bus = Bus()
    host = world(OSError("later"), bus)
    host.link._opener.join()
    host.link.close()
    host.link._open()
    assert bus.shut == 1 and host.link._bus is None


class BoardWorld:
    """Time and buses as the board's line sees them."""

    def __init__(self, monkeypatch):
        self.now_s, self.openings, self.bus, self.refusal = 1000.0, 0, None, None
        monkeypatch.setattr(link_module, "time", types.SimpleNamespace(monotonic=lambda: self.now_s))
        monkeypatch.setattr(link_module, "opened_bus", self._open)
        self.line = BusLine(CanParameters(interface="virtual", channel="test"))

    def _open(self, parameters):
        self.openings += 1
        if self.refusal:
            raise OSError(self.refusal)
        self.bus = Bus()
        return self.bus


@pytest.fixture
def board(monkeypatch):
    return BoardWorld(monkeypatch)


def test_the_board_receives_frames_with_data_and_their_time_and_sends_in_the_format_of_its_bus(board):
    seconds = 10**9
    board.bus.coming = [
        Frame(12 * seconds, OURS, 0, b"ab"),
        Frame(0, 0x20, ERROR, b""),
        Frame(0, OURS, REMOTE, b""),
        Frame(13 * seconds, 0x182, 0, b"c"),
    ]
    assert board.line.receive() == [(OURS, b"ab", 12 * seconds), (0x182, b"c", 13 * seconds)]
    assert board.line.receive() == []
    assert board.line.send(OURS, b"abc", False) and board.line.send(0x182, bytes(16), True)
    sent = [frame_of(one)[1:] for one in board.bus.sent]
    assert sent == [(OURS, 0, b"abc"), (0x182, FD_FRAME, bytes(16))]


def test_a_flood_is_taken_in_batches_and_none_of_it_is_lost(board):
    board.bus.coming = [Frame(0, k, 0, b"") for k in range(300)]
    batches = list(iter(board.line.receive, []))
    assert [identifier for batch in batches for identifier, *_ in batch] == list(range(300))
    assert max(map(len, batches)) == 64


@pytest.mark.parametrize(("refusal", "openings"), [(can.CanOperationError("full"), 1), (is_down(), 2)])
def test_a_bus_that_takes_no_frame_stays_open_and_one_that_is_down_is_opened_again(board, refusal, openings):
    board.bus.refusal = refusal
    assert board.line.send(OURS, b"", False) is False
    board.bus.refusal = None
    board.now_s += 0.1
    board.line.receive()
    assert board.openings == openings and board.line.send(OURS, b"", False) is True


def test_a_bus_that_is_lost_is_opened_again_a_tenth_of_a_second_after_it_was_opened(board):
    first = board.bus
    first.coming = [Frame(10**9, 1, 0, b"x"), OSError("gone")]
    # What came before the loss is kept.
    assert board.line.receive() == [(1, b"x", 10**9)] and first.shut == 1
    assert board.line.send(OURS, b"", False) is False
    board.now_s = 1000.09
    assert board.line.receive() == [] and board.openings == 1
    board.now_s = 1000.1
    board.line.receive()
    assert board.openings == 2 and board.line.send(OURS, b"", False) is True and len(board.bus.sent) == 1
    board.line.close()
    board.line.close()
    assert board.bus.shut == 1


def test_a_bus_that_does_not_open_is_tried_ten_times_a_second_and_complained_of_once(board, capsys):
    def lose(refusal):
        board.refusal = refusal
        board.bus.coming = [OSError("gone")]
        board.line.receive()

    lose("no such device")
    openings = board.openings
    for _ in range(100):
        board.now_s += 0.01
        assert board.line.receive() == []
    assert 9 <= board.openings - openings <= 10
    assert capsys.readouterr().err == "dsp_emulator: no such device\n"
    # After it was open for a while the same trouble is worth a word again.
    board.refusal, board.now_s = None, board.now_s + 1.0
    board.line.receive()
    lose("no such device")
    board.now_s += 1.0
    board.line.receive()
    assert capsys.readouterr().err == "dsp_emulator: no such device\n"
