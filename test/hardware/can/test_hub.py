"""The bus between processes, as python-can sees it, and the link that comes back."""

import threading
import time

import can
import pytest
from waiting import comes_true

from straightcomp_ros.hardware.can import hub_bus
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.hub import (
    ERROR,
    EXTENDED,
    FD,
    FD_FRAME,
    KINDS,
    LONGEST,
    REMOTE,
    Faults,
    Frame,
    Hub,
    from_packet,
    priority,
    to_packet,
)
from straightcomp_ros.hardware.can.hub_bus import INTERFACE, frame_of, message_of
from straightcomp_ros.hardware.can.link import Link
from straightcomp_ros.hardware.interface import HardwareError


class RunningHub:
    def __init__(self, path, fault=None):
        self.path, self.hub = str(path), Hub(path, fault)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.hub.run, args=(self._stop.is_set,))
        self._thread.start()

    def close(self):
        self._stop.set()
        self._thread.join()
        self.hub.close()

    def bus(self, **options):
        return can.Bus(interface=INTERFACE, channel=self.path, fd=True, **options)


@pytest.fixture
def hub(tmp_path):
    hub = RunningHub(tmp_path / "bus")
    yield hub
    hub.close()


def until(condition):
    assert comes_true(condition, 20.0)


def message(identifier, data=b"", **options):
    return can.Message(arbitration_id=identifier, data=data, **{"is_extended_id": False, **options})


def test_frames_of_all_kinds_arrive_at_the_others_unchanged_and_in_order(hub):
    sent = [
        message(0x181, bytes(range(8))),
        message(0x381, bytes(64), is_fd=True, bitrate_switch=True),
        message(0x1ABCDEF0, is_extended_id=True),
        message(0x20, bytes(8), is_error_frame=True),
        message(0x100, is_remote_frame=True),
        *(message(number, bytes([number % 256])) for number in range(2000)),
    ]
    with hub.bus() as sender, hub.bus() as first, hub.bus() as second:
        until(lambda: len(hub.hub._nodes) == 3)
        for one in sent:
            sender.send(one, timeout=5)
        for receiver in (first, second):
            for one in sent:
                arrived = receiver.recv(10)
                assert one.equals(arrived, timestamp_delta=None, check_channel=False, check_direction=False)
                assert 0 <= time.time() - arrived.timestamp < 60
        assert sender.recv(0) is None and hub.hub.dropped == 0


def test_filters_keep_others_frames_away_and_let_error_frames_pass(hub):
    filters = [{"can_id": 0x181, "can_mask": 0x7FF, "extended": False}]
    with hub.bus() as sender, hub.bus(can_filters=filters) as receiver:
        until(lambda: len(hub.hub._nodes) == 2)
        for one in (message(0x180), message(0x181), message(0x182), message(0x40, bytes(8), is_error_frame=True)):
            sender.send(one)
        assert receiver.recv(10).arbitration_id == 0x181 and receiver.recv(10).is_error_frame


def test_a_node_that_does_not_fetch_loses_frames_and_holds_no_other_up(hub):
    with hub.bus() as sender, hub.bus(), hub.bus() as attentive:
        until(lambda: len(hub.hub._nodes) == 3)
        for _ in range(100):
            for _ in range(50):
                sender.send(message(1, bytes(64), is_fd=True), timeout=10)
            for _ in range(50):
                assert attentive.recv(10) is not None
        assert hub.hub.dropped > 0


def test_a_node_whose_frames_no_node_takes_gets_an_error_and_goes_on_when_they_are_taken(tmp_path):
    hub = Hub(tmp_path / "bus")
    bus = can.Bus(interface=INTERFACE, channel=str(tmp_path / "bus"), fd=True)
    hub.run(lambda: len(hub._nodes) == 1)
    large, sent = message(1, bytes(64), is_fd=True), 0
    with pytest.raises(can.CanOperationError, match="transmit buffer full"):
        while sent < 1_000_000:
            bus.send(large)
            sent += 1
    with pytest.raises(can.CanOperationError, match="transmit buffer full"):
        bus.send(large, timeout=0.01)
    taking = threading.Thread(target=hub.run, args=(lambda: hub.passed > sent,))
    taking.start()
    bus.send(large, timeout=60)
    taking.join()
    assert hub.passed == sent + 1
    hub.close()
    with pytest.raises(can.CanOperationError, match="hub: "):
        bus.send(large)
    with pytest.raises(can.CanOperationError, match="hub"):
        bus.recv(1.0)
    bus.shutdown()


@pytest.mark.parametrize("selectable", [True, False], ids=["select", "poll"])
def test_a_node_waits_for_a_frame_as_long_as_it_is_asked_to(hub, monkeypatch, selectable):
    if not selectable:
        # Programs with more than a thousand open files have such descriptors.
        monkeypatch.setattr(hub_bus, "_SELECTABLE", 0)
    with hub.bus() as sender, hub.bus() as receiver:
        until(lambda: len(hub.hub._nodes) == 2)
        begin = time.monotonic()
        assert receiver.recv_frame(0.05) is None and receiver.recv(0.05) is None
        assert time.monotonic() - begin >= 0.1
        assert receiver.recv_frame(0.0) is None
        threading.Timer(0.02, sender.send_frame, (0x181, 0, b"\1")).start()
        assert receiver.recv_frame(60.0).identifier == 0x181
        threading.Timer(0.02, sender.send_frame, (0x182, 0, b"\1")).start()
        assert receiver.recv(None).arbitration_id == 0x182


def test_of_the_frames_that_wait_the_lowest_identifier_goes_first_and_each_node_keeps_its_order(tmp_path):
    hub = Hub(tmp_path / "bus")
    first, second, receiver = (can.Bus(interface=INTERFACE, channel=str(tmp_path / "bus")) for _ in range(3))
    hub.run(lambda: len(hub._nodes) == 3)
    for sender, identifiers in ((first, (0x300, 0x100)), (second, (0x200, 0x50))):
        for identifier in identifiers:
            sender.send(message(identifier))
    hub.run(lambda: hub.passed == 4)
    assert [receiver.recv(10).arbitration_id for _ in range(4)] == [0x200, 0x50, 0x300, 0x100]
    for bus in (first, second, receiver):
        bus.shutdown()
    hub.close()


def test_a_hub_takes_over_a_socket_that_was_left_but_not_one_in_use(tmp_path, hub):
    with pytest.raises(HardwareError, match="another one listens"):
        Hub(hub.path)
    left = Hub(tmp_path / "left")
    left._listener.close()
    Hub(tmp_path / "left").close()


def test_without_a_hub_the_message_names_the_socket(tmp_path):
    with pytest.raises(can.CanInitializationError, match=r"no hub at '.*nowhere'"):
        can.Bus(interface=INTERFACE, channel=str(tmp_path / "nowhere"))


def test_a_link_that_was_cut_is_opened_again_and_goes_on(hub):
    arrived = []
    parameters = CanParameters(interface=INTERFACE, channel=hub.path)
    link = Link(parameters, [0x181], lambda frame, stamp: arrived.append(frame.data[0]), time.time_ns)
    assert "not open" in link.problem and not link.send(0x201, b"", fd=False)
    link.start()
    until(lambda: len(hub.hub._nodes) == 1)
    hub.hub.cut()
    until(lambda: not link.wait(0.0) and link.openings == 2 and not link.problem)
    with hub.bus() as sender:
        until(lambda: len(hub.hub._nodes) == 2)
        sender.send(message(0x181, b"\7"))
        assert link.wait(10.0) == 1 and arrived == [7]
        assert link.send(0x201, b"\1", fd=False)
        assert sender.recv(10).data == b"\1"
    link.close()
    assert link.transmit_full == 1


def test_faults_in_the_hub_reach_the_nodes(tmp_path):
    faults = Faults({"drop": 0.5}, seed=3)
    hub = RunningHub(tmp_path / "bus", faults)
    with hub.bus() as sender, hub.bus() as receiver:
        until(lambda: len(hub.hub._nodes) == 2)
        for number in range(200):
            sender.send(message(1, [number]))
        until(lambda: hub.hub.passed == 200)
        arrived = [one.data[0] for one in iter(lambda: receiver.recv(0.2), None)]
    hub.close()
    assert arrived == sorted(arrived) and len(arrived) == 200 - faults.injected["drop"] < 150


def test_faults_are_the_same_for_the_same_seed_and_unknown_ones_are_refused():
    def spoiled(seed):
        faults = Faults({kind: 0.05 for kind in KINDS if kind != "cut"}, seed)
        frames = [Frame(0, 0x181, 0, bytes([number % 256] * 8)) for number in range(500)]
        return [arrived for frame in frames for arrived in faults(frame)]

    assert spoiled(1) == spoiled(1) != spoiled(2)
    with pytest.raises(ValueError, match="'gnaw' is unknown; allowed: drop"):
        Faults({"gnaw": 0.1})
    with pytest.raises(ValueError, match="rate of 2"):
        Faults({"drop": 2})


def test_a_member_of_the_hubs_own_process_talks_to_all_nodes(tmp_path):
    received = []
    hub = Hub(tmp_path / "bus", member=received.append)
    first, second = (can.Bus(interface=INTERFACE, channel=str(tmp_path / "bus"), fd=True) for _ in range(2))
    sent = [message(0x301, b"\1\2", is_fd=True), message(0x40, bytes(8), is_error_frame=True)]
    for one in sent:
        first.send(one)
    hub.run(lambda: hub.passed == 2)
    assert [(one.identifier, one.flags, one.data) for one in received] == [
        (0x301, FD, b"\1\2"),
        (0x40, ERROR, bytes(8)),
    ]
    assert hub.send(0x381, bytes(16), fd=True) and hub.send(0x701, b"\5", fd=False)
    for node, identifiers in ((first, [0x381, 0x701]), (second, [0x301, 0x40, 0x381, 0x701])):
        arrived = [node.recv(10) for _ in identifiers]
        assert [one.arbitration_id for one in arrived] == identifiers
        assert arrived[-2].is_fd and not arrived[-1].is_fd and 0 <= time.time() - arrived[-1].timestamp < 60
        node.shutdown()
    assert len(received) == 2
    hub.close()
    assert not (tmp_path / "bus").exists()


def test_a_frame_comes_out_of_its_packet_and_out_of_its_message_as_it_was():
    for flags, size in ((0, 8), (EXTENDED, 0), (FD_FRAME, 64), (REMOTE, 0), (ERROR, 8), (EXTENDED | FD_FRAME, 12)):
        frame = Frame(1_700_000_000_000_001_024, 0x181, flags, bytes(range(size)))
        packet = to_packet(frame)
        assert from_packet(packet) == frame and len(packet) == 13 + size <= LONGEST
        made = message_of(frame)
        # python-can keeps the time as a float of seconds, which has a quarter of a microsecond at this date.
        assert frame_of(made)._replace(stamp_ns=frame.stamp_ns) == frame
        assert abs(frame_of(made).stamp_ns - frame.stamp_ns) < 500
        assert made.timestamp == pytest.approx(1.7e9)


def test_a_standard_frame_wins_over_an_extended_one_with_the_same_first_bits():
    def order(identifier, flags=0):
        return priority(to_packet(Frame(0, identifier, flags, b"")))

    extended = [0x181 << 18, 0x181 << 18 | 1, 0x181 << 18 | 0x3FFFF]
    ranks = [order(0x180), order(0x181), *(order(identifier, EXTENDED) for identifier in extended), order(0x182)]
    assert ranks == sorted(ranks) and len(set(ranks)) == len(ranks)


def test_a_fault_of_rate_one_is_made_every_time_and_of_rate_zero_never():
    frame = Frame(0, 0x181, 0, bytes(8))
    for kind in ("drop", "duplicate", "corrupt", "truncate", "wrong_id"):
        faults = Faults({kind: 1.0})
        arrived = [faults(frame) for _ in range(50)]
        assert faults.injected == {kind: 50} and [frame] not in arrived
        never = Faults({kind: 0.0})
        assert [never(frame) for _ in range(50)] == [[frame]] * 50 and never.injected == {kind: 0}
    # A request has the identifier of the frame, in either of its lengths, and no data.
    for flags in (EXTENDED, FD_FRAME):
        request, own = Faults({"remote": 1.0})(frame._replace(flags=flags))
        assert own.data and request == (0, 0x181, flags & EXTENDED | REMOTE, b"")
    # One or two bits of a corrupt frame are wrong, and both numbers happen.
    faults = Faults({"corrupt": 1.0})
    bits = [bin(int.from_bytes(faults(frame)[0].data, "little")).count("1") for _ in range(200)]
    assert set(bits) == {1, 2}
    # A frame under another identifier differs in one of eleven bits.
    faults = Faults({"wrong_id": 1.0})
    changed = {faults(frame)[0].identifier ^ 0x181 for _ in range(400)}
    assert changed == {1 << bit for bit in range(11)}


def test_two_frames_of_a_kind_are_swapped_and_two_of_different_kinds_are_not():
    first, second = Frame(0, 0x181, 0, b"1"), Frame(1, 0x181, 0, b"2")
    other = Frame(2, 0x281, 0, b"3")
    faults = Faults({"reorder": 1.0})
    assert faults(first) == [] and faults(second) == [second, first] and faults.injected == {"reorder": 1}
    assert faults(first) == [] and faults(other) == [first] and faults.injected == {"reorder": 1}
