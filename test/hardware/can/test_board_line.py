"""The emulated board's connection to a bus of python-can: frames in both directions, and what follows a loss."""

import errno
import types

import can
import pytest

from straightcomp_ros.hardware.can import link
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.link import BusLine


class Bus:
    """A bus at hand: what is read from it, what was sent, whether it fails."""

    def __init__(self):
        self.incoming, self.sent, self.fails, self.closed = [], [], False, False

    def send(self, message):
        if self.fails:
            raise can.CanOperationError("gone")
        self.sent.append(message)

    def recv(self, timeout):
        assert timeout == 0
        if self.fails:
            raise can.CanOperationError("gone")
        return self.incoming.pop(0) if self.incoming else None

    def shutdown(self):
        self.closed = True
        raise can.CanOperationError("gone already")


class World:
    """Time and buses as the line under test sees them."""

    def __init__(self):
        self.now_s, self.openings, self.bus, self.refusal = 1000.0, 0, Bus(), None

    def open(self, parameters):
        self.openings += 1
        if self.refusal:
            raise OSError(self.refusal)
        self.bus = Bus()
        return self.bus


@pytest.fixture
def world(monkeypatch):
    world = World()
    monkeypatch.setattr(link, "time", types.SimpleNamespace(monotonic=lambda: world.now_s))
    monkeypatch.setattr(link, "opened_bus", world.open)
    return world


def line():
    return BusLine(CanParameters(interface="virtual", channel="test"))


def message(identifier, data, stamp_s=0.0, **kind):
    return can.Message(arbitration_id=identifier, data=data, timestamp=stamp_s, is_extended_id=False, **kind)


def test_frames_are_received_with_their_time_in_nanoseconds_and_those_without_data_are_not(world):
    opened = line()
    world.bus.incoming = [
        message(0x181, b"ab", 12.5),
        message(0x20, b"", is_error_frame=True),
        message(0x181, None, is_remote_frame=True),
        message(0x182, b"c", 13.0),
    ]
    assert opened.receive() == [(0x181, b"ab", 12_500_000_000), (0x182, b"c", 13_000_000_000)]
    assert opened.receive() == []


def test_a_frame_is_sent_as_a_standard_one_in_the_format_of_its_bus(world):
    opened = line()
    assert opened.send(0x181, b"abc", False) and opened.send(0x182, bytes(16), True)
    classic, fd = world.bus.sent
    assert (classic.arbitration_id, bytes(classic.data), classic.is_fd, classic.bitrate_switch) == (
        0x181,
        b"abc",
        False,
        False,
    )
    assert (fd.arbitration_id, len(fd.data), fd.is_fd, fd.bitrate_switch) == (0x182, 16, True, True)
    assert not classic.is_extended_id and not fd.is_extended_id


def test_a_flood_is_taken_in_parts_and_none_of_it_is_lost(world):
    opened = line()
    world.bus.incoming = [message(k, b"") for k in range(300)]
    parts = []
    while part := opened.receive():
        parts.append(part)
    assert [identifier for part in parts for identifier, *_ in part] == list(range(300))
    assert max(map(len, parts)) == 64


def test_a_bus_that_takes_no_frame_says_so_and_stays_open(world):
    opened = line()
    world.bus.fails = True
    assert opened.send(0x181, b"", False) is False
    world.bus.fails = False
    assert opened.send(0x181, b"", False) is True
    assert world.openings == 1


def test_an_interface_that_sending_finds_down_is_opened_again(world):
    opened = line()
    first = world.bus

    def send(_):
        raise can.CanOperationError("down") from OSError(errno.ENETDOWN, "down")

    first.send = send
    assert opened.send(0x181, b"", False) is False and first.closed
    world.now_s += 0.1
    opened.receive()
    assert world.openings == 2 and opened.send(0x181, b"", False) is True


def test_a_bus_that_is_lost_is_closed_and_opened_again_a_tenth_of_a_second_after_it_was_opened(world):
    opened = line()
    first = world.bus
    first.fails = True
    first.incoming = [message(1, b"")]
    assert opened.receive() == [] and first.closed
    assert opened.send(0x181, b"", False) is False
    world.now_s += 0.09
    assert opened.receive() == [] and world.openings == 1
    # It was opened at 1000 s.
    world.now_s = 1000.0 + 0.1
    opened.receive()
    assert world.openings == 2 and opened.send(0x181, b"", False) is True and len(world.bus.sent) == 1


def test_what_came_before_a_loss_is_kept(world):
    opened = line()
    messages = iter([message(1, b"x", 1.0)])

    def recv(_):
        for found in messages:
            return found
        raise OSError("gone")

    world.bus.recv = recv
    assert opened.receive() == [(1, b"x", 1_000_000_000)]


def test_a_bus_that_does_not_open_is_tried_ten_times_a_second_and_complained_of_once(world, capsys):
    world.refusal = "no such device"
    opened = line()
    for _ in range(100):
        world.now_s += 0.01
        assert opened.receive() == []
    assert 9 <= world.openings - 1 <= 10
    assert capsys.readouterr().err == "dsp_emulator: no such device\n"
    world.refusal = "busy"
    world.now_s += 1.0
    opened.receive()
    assert capsys.readouterr().err == "dsp_emulator: busy\n"
    # After it was open for a while the same trouble is worth telling again.
    world.refusal = None
    world.now_s += 1.0
    opened.receive()
    world.bus.fails, world.refusal = True, "busy"
    world.now_s += 1.0
    opened.receive()
    opened.receive()
    assert capsys.readouterr().err == "dsp_emulator: busy\n"


def test_a_closed_line_has_left_its_bus(world):
    opened = line()
    opened.close()
    opened.close()
    assert world.bus.closed
