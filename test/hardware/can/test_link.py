"""The connection to the bus: what is let through, when it came, how much at once, and a bus that fails."""

import contextlib
import errno
import time
from unittest.mock import Mock

import can
import pytest
from waiting import comes_true

from straightcomp_ros.hardware.can import link as link_module
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID
from straightcomp_ros.hardware.can.frame_log import RecordedBus
from straightcomp_ros.hardware.can.hub import ERROR, FD_FRAME, REMOTE, Frame
from straightcomp_ros.hardware.can.hub_bus import frame_of, message_of
from straightcomp_ros.hardware.can.link import Link, filter_of, opened_bus
from straightcomp_ros.nodes.dsp_emulator import Emulator
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters

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


class World:
    """A link on buses from a list; the host's clock runs ten seconds ahead of the system's."""

    def __init__(self, monkeypatch, buses, **changes):
        self.buses, self.arrived = list(buses), []
        monkeypatch.setattr(link_module, "opened_bus", self.open)
        parameters = CanParameters(**{"interface": "virtual", "fd": True} | changes)
        self.link = Link(parameters, [OURS], self._receive, self.clock)

    def open(self, parameters, filters):
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
        assert comes_true(lambda: not self.link.wait(0.001) and self.link.openings >= times, 60.0), self.link.problem
        return self


@pytest.fixture
def world(monkeypatch):
    with contextlib.ExitStack() as stack:

        def make(*buses, **changes):
            made = World(monkeypatch, buses, **changes)
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
        frame(OURS | EXTENDED_ID),
        frame(OURS, FD_FRAME),
        frame(OURS, REMOTE, b""),
        frame(0x20000004 | EXTENDED_ID, ERROR, bytes(8)),
    ]
    assert host.link.wait(0.0) == 5
    assert [one.flags for one, _ in host.arrived] == [FD_FRAME, REMOTE, ERROR]
    assert host.filters == [{"can_id": OURS, "can_mask": 0x7FF, "extended": False}]
    wide = {"can_id": 0x18FF0201, "can_mask": 0x1FFFFFFF, "extended": True}
    assert filter_of(0x18FF0201 | EXTENDED_ID) == wide


def test_a_log_has_what_came_in_and_what_went_out_under_the_name_of_its_bus(world, tmp_path):
    bus = Bus()
    host = world(bus, channel="link", log=str(tmp_path / "logs" / "bus.log")).opened()
    assert host.link.send(0x301, b"\1\2", fd=True)
    bus.coming = [frame(), frame(data=b"\2")]
    assert host.link.wait(0.0) == 2
    host.link.close()
    read = list(RecordedBus(host.link.log.file))
    assert [(one.arbitration_id, one.is_rx) for one in read] == [(0x301, False), (OURS, True), (OURS, True)]
    assert {one.channel for one in read} == {"link"} and abs(read[0].timestamp - time.time()) < 300


@pytest.mark.parametrize(
    ("ago_ns", "interface", "used"),
    [
        (4_000_000_000, "virtual", True),
        (6_000_000_000, "virtual", False),
        (-(10**9), "virtual", False),
        (4_000_000_000, "kvaser", False),  # its own timer, set once
        (10**18, "pcan", False),  # since the computer was started
    ],
)
def test_arrival_and_log_have_the_stamp_of_a_frame_if_that_is_the_systems_and_else_now(
    world, tmp_path, ago_ns, interface, used
):
    host = world(Bus(frame(ago_ns=ago_ns)), interface=interface, log=str(tmp_path / "run.log")).opened()
    host.link.wait(0.0)
    ((_, arrival_ns),) = host.arrived
    host.link.close()
    (logged,) = RecordedBus(tmp_path / "run.log")
    for stamp_ns, now_ns in ((arrival_ns, host.clock()), (logged.timestamp * 1e9, time.time_ns())):
        assert stamp_ns == pytest.approx(now_ns - (ago_ns if used else 0), abs=1e9)


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
    sent = [frame_of(one)[1:] for one in bus.sent]
    assert sent == [(0x201, 0, b"\1\2"), (0x301, FD_FRAME, b"\3")] and host.link.transmit_full == 0
    bus.refusal = can.CanOperationError("transmit queue full")
    assert not host.link.send(0x201, b"", fd=False)
    assert host.link.transmit_full == 1 and not host.link.problem


@pytest.mark.parametrize("found_by", ["sending", "reading"])
def test_a_bus_that_fails_is_closed_named_and_opened_again(world, found_by):
    first, second = Bus(), Bus()
    host = world(first, second).opened()
    assert host.link.problem == ""
    if found_by == "sending":
        # As python-can's SocketCAN.
        first.refusal = can.CanOperationError("the network is down")
        first.refusal.__cause__ = OSError(errno.ENETDOWN, "down")
        assert not host.link.send(0x201, b"", fd=False)
    else:
        first.coming = [OSError("the network is down")]
        assert host.link.wait(0.0) == 0
    assert first.shut == 1 and host.link.problem == "CAN virtual can0: the network is down"
    assert not host.link.send(0x201, b"", fd=False)
    host.opened(2)
    second.coming = [frame()]
    assert host.link.wait(0.0) == 1 and host.link.send(0x201, b"", fd=False) and host.link.problem == ""


def test_the_time_to_the_next_opening_doubles_up_to_a_second_and_is_short_again_after_a_frame(world, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(link_module.time, "monotonic", lambda: now[0])
    bus = Bus()
    host = world(*[OSError("no adapter")] * 9, bus, OSError("once more"))
    link, waits = host.link, []
    for left in range(10, 1, -1):
        link._opener.join(60.0)
        assert len(host.buses) == left
        waits.append(link._next_opening_s - now[0])
        # Not a moment before its time.
        link.wait(0.0)
        assert len(host.buses) == left and not link._opener.is_alive()
        now[0] = link._next_opening_s
        link.wait(0.0)
    link._opener.join(60.0)
    assert link.openings == 1
    assert waits == pytest.approx([0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.0, 1.0, 1.0])
    bus.coming = [OSError("opened, but down")]
    link.wait(0.0)
    assert link._next_opening_s - now[0] == pytest.approx(1.0)
    link._bus, bus.coming = bus, [frame(), OSError("gone")]
    link.wait(0.0)
    assert link._next_opening_s - now[0] == pytest.approx(0.02)


def test_to_start_again_opens_the_bus_anew_and_a_bus_that_opens_after_the_close_is_shut(world):
    first, second, late = Bus(), Bus(), Bus()
    host = world(first, second, late).opened()
    host.link.start()
    assert first.shut == 1
    host.opened(2)
    assert host.link.problem == "" and second.shut == 0
    host.link.close()
    host.link.open()
    assert late.shut == 1 and host.link._bus is None


def test_an_unknown_interface_is_refused_with_those_that_are_known():
    with pytest.raises(ParameterError, match=r"'pigeon' is not known; allowed: .*socketcan"):
        Link(CanParameters(interface="pigeon"), [], lambda *_: None, time.time_ns)


def test_whatever_error_an_interface_raises_is_one_of_the_bus():
    with pytest.raises(can.CanError, match="channel must be an integer"):
        opened_bus(CanParameters(interface="kvaser", channel="first"))


def test_an_emulated_board_gets_its_frames_with_data_and_says_once_what_its_bus_lacks(monkeypatch, capsys):
    values = shipped_parameters()
    values["driver"] |= {"hardware": "can", "can.interface": "virtual", "can.log": "the_drivers.log"}
    driver, bus = node_parameters("driver", values), Bus()
    host = World(monkeypatch, [OSError("no device"), OSError("no device"), bus])
    emulator = Emulator(driver)
    assert emulator._line.log is None
    board = emulator._board = Mock(**{"stage.refused": ""})
    assert comes_true(lambda: emulator._cycle(0) or emulator._line.openings, 60.0)
    assert capsys.readouterr().err.count("CAN virtual can0: no device") == 1
    ours = driver.can.make_wire().command.identifier
    assert ours in {one["can_id"] for one in host.filters}
    bus.coming = [
        frame(ours, FD_FRAME, b"ab", ago_ns=10**9),
        frame(0x20, ERROR, b""),
        frame(ours, REMOTE, b""),
        frame(OURS, 0, b"c"),
    ]
    emulator._cycle(0)
    ((identifier, payload, arrival_ns),) = (call.args for call in board.receive.call_args_list)
    assert (identifier, payload) == (ours, b"ab")
    # It counts from its time on the bus.
    assert arrival_ns == pytest.approx(emulator._now_ns() - 10**9, abs=9e8)
    bus.coming = [OSError("gone")]
    emulator._cycle(0)
    emulator._cycle(0)
    assert capsys.readouterr().err.count("CAN virtual can0: gone") == 1
    emulator.close()
