"""The bus between processes, as python-can sees it, and the link that comes back."""

import contextlib
import signal
import subprocess
import threading
import time
from functools import partial

import can
import pytest
from waiting import comes_true

from straightcomp_ros.cell.launcher import verb_command
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID
from straightcomp_ros.hardware.can.hub import ERROR, FD, FD_FRAME, REMOTE, Faults, Frame, Hub, LinkCut
from straightcomp_ros.hardware.can.hub_bus import INTERFACE, frame_of
from straightcomp_ros.hardware.can.link import Link
from straightcomp_ros.hardware.interface import HardwareError

WAITING = "transmit buffer full"


class World:
    """A hub that passes frames on when it is asked to, and nodes of its bus."""

    def __init__(self, path, stack, **options):
        self.path, self.hub, self._stack = str(path), Hub(path, **options), stack
        stack.callback(self.hub.close)

    def nodes(self, count, **options):
        made = [can.Bus(interface=INTERFACE, channel=self.path, fd=True, **options) for _ in range(count)]
        for bus in made:
            self._stack.callback(bus.shutdown)
        known = len(self.hub._nodes)
        self.hub.run(lambda: len(self.hub._nodes) == known + count)
        return made

    def send(self, sender, *messages):
        """Send messages and pass them on."""
        passed = self.hub.passed + len(messages)
        for one in messages:
            sender.send(one)
        self.hub.run(lambda: self.hub.passed == passed)


@pytest.fixture
def make(tmp_path):
    with contextlib.ExitStack() as stack:
        yield partial(World, tmp_path / "bus", stack)


@pytest.fixture
def world(make):
    return make()


@pytest.mark.parametrize("handling", [signal.SIG_DFL, signal.SIG_IGN])
def test_a_terminal_that_is_closed_ends_the_program_in_order_unless_nohup_started_it(tmp_path, handling):
    command = verb_command("can", "hub", "--socket", str(tmp_path / "bus"))
    begin = partial(signal.signal, signal.SIGHUP, handling)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=begin) as hub:
        try:
            assert hub.stdout.readline() == "ready\n"
            hub.send_signal(signal.SIGHUP)
            if handling is signal.SIG_IGN:
                with pytest.raises(subprocess.TimeoutExpired):
                    hub.wait(1.0)
                hub.terminate()
            assert hub.stdout.readline().startswith("passed 0,") and hub.wait(120.0) == 0
        finally:
            hub.kill()


def message(identifier, data=b"", **options):
    return can.Message(arbitration_id=identifier, data=data, **{"is_extended_id": False, **options})


def test_frames_of_all_kinds_arrive_at_the_others_unchanged_and_in_order(world):
    sender, *receivers = world.nodes(3)
    sent = [
        message(0x181, bytes(range(8))),
        message(0x381, bytes(64), is_fd=True, bitrate_switch=True),
        message(0x1ABCDEF0, bytes(range(12)), is_extended_id=True, is_fd=True, bitrate_switch=True),
        message(0x20, bytes(8), is_error_frame=True),
        message(0x100, is_remote_frame=True),
        *(message(number, bytes([number % 256])) for number in range(2000)),
    ]
    for first in range(0, len(sent), 50):
        world.send(sender, *sent[first : first + 50])
        for receiver in receivers:
            for one in sent[first : first + 50]:
                arrived = receiver.recv(10)
                assert one.equals(arrived, timestamp_delta=None, check_channel=False, check_direction=False)
                assert 0 <= time.time() - arrived.timestamp < 60
    assert sender.recv(0) is None and world.hub.dropped == 0


def test_filters_keep_others_frames_away_and_let_error_frames_pass(world):
    (sender,) = world.nodes(1)
    (receiver,) = world.nodes(1, can_filters=[{"can_id": 0x181, "can_mask": 0x7FF, "extended": False}])
    error = message(0x40, bytes(8), is_error_frame=True)
    world.send(sender, message(0x180), message(0x181), message(0x182), error)
    assert receiver.recv(10).arbitration_id == 0x181 and receiver.recv(10).is_error_frame


def test_a_node_that_does_not_fetch_loses_frames_and_holds_no_other_up(world):
    sender, _, attentive = world.nodes(3)
    for _ in range(100):
        world.send(sender, *[message(1, bytes(64), is_fd=True)] * 50)
        assert None not in [attentive.recv(10) for _ in range(50)]
    assert world.hub.dropped > 0


def test_a_node_whose_frames_no_node_takes_gets_an_error_and_goes_on_when_they_are_taken(world):
    (bus,), hub = world.nodes(1), world.hub
    large, sent = message(1, bytes(64), is_fd=True), 0
    with pytest.raises(can.CanOperationError, match=WAITING):
        while sent < 1_000_000:
            bus.send(large)
            sent += 1
    with pytest.raises(can.CanOperationError, match=WAITING):
        bus.send(large, timeout=0.01)
    taking = threading.Thread(target=hub.run, args=(lambda: hub.passed > sent,))
    taking.start()
    bus.send(large, timeout=60)
    taking.join()
    assert hub.passed == sent + 1
    hub.cut()
    for call in (partial(bus.send, large), partial(bus.recv, 1.0)):
        with pytest.raises(can.CanOperationError, match="hub"):
            call()
    bus.shutdown()
    with pytest.raises(can.CanOperationError):
        bus.send(large, timeout=0.01)


def test_a_node_waits_for_a_frame_as_long_as_it_is_asked_to(world):
    sender, receiver = world.nodes(2)
    begin = time.monotonic()
    assert receiver.recv_frame(0.05) is None and receiver.recv(0.05) is None
    assert time.monotonic() - begin >= 0.1
    assert receiver.recv_frame(0.0) is None
    for identifier, receive in ((0x181, partial(receiver.recv_frame, 60.0)), (0x182, partial(receiver.recv, None))):
        sending = threading.Timer(0.02, world.send, (sender, message(identifier, b"\1")))
        sending.start()
        arrived = receive()
        assert (arrived if isinstance(arrived, Frame) else frame_of(arrived)).identifier == identifier
        sending.join()


def test_nodes_take_turns_and_each_keeps_the_order_of_its_frames(world):
    first, second, receiver = world.nodes(3)
    for number in range(40):
        first.send(message(0x300 + number))
    second.send(message(0x200))
    begin = time.monotonic()
    while world.hub.passed < 41:
        world.hub.wait(100.0)
    assert time.monotonic() - begin < 30
    world.hub.wait(0.02)
    assert time.monotonic() - begin >= 0.019
    arrived = [receiver.recv(10).arbitration_id for _ in range(41)]
    assert arrived.index(0x200) < 40 and [one for one in arrived if one != 0x200] == [*range(0x300, 0x328)]


def test_a_hub_takes_over_a_socket_that_was_left_but_not_one_in_use_and_without_one_a_node_says_so(tmp_path, world):
    with pytest.raises(HardwareError, match="another one listens"):
        Hub(world.path)
    left = Hub(tmp_path / "left")
    left._listener.close()
    Hub(tmp_path / "left").close()
    assert not (tmp_path / "left").exists()
    with pytest.raises(can.CanInitializationError, match=r"no hub at '.*left'"):
        can.Bus(interface=INTERFACE, channel=str(tmp_path / "left"))


def test_a_link_that_was_cut_is_opened_again_and_goes_on(world):
    arrived, hub = [], world.hub
    parameters = CanParameters(interface=INTERFACE, channel=world.path)
    link = Link(parameters, [0x181], lambda frame, stamp: arrived.append(frame.data[0]), time.time_ns)
    assert "not open" in link.problem and not link.send(0x201, b"", fd=False)
    link.start()
    assert comes_true(lambda: hub.wait(0.0) or len(hub._nodes) == 1)
    hub.cut()
    assert comes_true(lambda: hub.wait(0.0) or (not link.wait(0.0) and link.openings == 2 and len(hub._nodes) == 1))
    (sender,) = world.nodes(1)
    world.send(sender, message(0x181, b"\7"))
    assert link.wait(10.0) == 1 and arrived == [7] and not link.problem
    assert link.send(0x201, b"\1", fd=False)
    hub.run(lambda: hub.passed == 2)
    assert sender.recv(10).data == b"\1"
    link.close()
    assert link.transmit_full == 1


def test_a_member_of_the_hubs_own_process_talks_to_all_nodes(make):
    received = []
    world = make(member=received.append)
    first, second = world.nodes(2)
    world.send(first, message(0x301, b"\1\2", is_fd=True), message(0x40, bytes(8), is_error_frame=True))
    frames = [(0x301, FD, b"\1\2"), (0x40, ERROR, bytes(8))]
    assert [one[1:] for one in received] == frames
    assert world.hub.send(0x381, bytes(16), fd=True) and world.hub.send(0x701, b"\5", fd=False)
    frames += [(0x381, FD_FRAME, bytes(16)), (0x701, 0, b"\5")]
    for node, its in ((first, frames[2:]), (second, frames)):
        arrived = [frame_of(node.recv(10)) for _ in its]
        assert [one[1:] for one in arrived] == its and 0 <= time.time_ns() - arrived[-1].stamp_ns < 60e9
    assert len(received) == 2


def test_faults_in_the_hub_reach_the_nodes(make):
    faults = Faults({"drop": 0.5}, seed=3)
    world = make(fault=faults)
    sender, receiver = world.nodes(2)
    world.send(sender, *(message(1, [number]) for number in range(200)))
    arrived = [one.data[0] for one in iter(lambda: receiver.recv(0.0), None)]
    assert arrived == sorted(arrived) and len(arrived) == 200 - faults.injected["drop"] < 150


SENT = Frame(7, 0x181 | EXTENDED_ID, FD_FRAME, bytes(range(12)))


def bits_of(frame):
    return int.from_bytes(frame.data, "little")


@pytest.mark.parametrize(
    ("kind", "arrive"),
    [
        ("drop", lambda: []),
        ("duplicate", lambda: [SENT, SENT]),
        ("error_frame", lambda: [Frame(7, 0x20, ERROR, bytes(8)), SENT]),
        ("remote", lambda: [Frame(7, SENT.identifier, REMOTE, b""), SENT]),
        ("flood", lambda: [SENT._replace(identifier=7 | EXTENDED_ID)] * 20 + [SENT]),
    ],
)
def test_a_fault_is_what_it_is_called_at_its_rate_and_its_seed_gives_it_again(kind, arrive):
    faults, again = (Faults({kind: 0.25}, seed=5) for _ in range(2))
    found = [faults(SENT) for _ in range(4000)]
    assert found == [again(SENT) for _ in range(4000)]
    assert found.count(arrive()) == faults.injected[kind] == pytest.approx(1000, abs=100)
    assert found.count([SENT]) == 4000 - faults.injected[kind]
    assert Faults({kind: 0.0})(SENT) == [SENT] and Faults({kind: 1.0})(SENT) == arrive()


def test_a_damaged_frame_is_damaged_in_all_the_ways_of_its_kind_and_in_no_other():
    def found(kind, field):
        """Frames of 3000 damaged ones, which differ from the one that was sent in this field alone."""
        faults = Faults({kind: 1.0})
        frames = [one for _ in range(3000) for one in faults(SENT)]
        assert len(frames) == 3000
        assert {one._replace(**{field: getattr(SENT, field)}) for one in frames} == {SENT}
        return set(frames)

    corrupt, garbled = found("corrupt", "data"), found("garble", "data")
    wrong_bits = {bits_of(one) ^ bits_of(SENT) for one in corrupt}
    assert wrong_bits > {1 << bit for bit in range(96)} and {bits.bit_count() for bits in wrong_bits} == {1, 2}
    assert len(garbled) == 3000 and {len(one.data) for one in corrupt | garbled} == {12}
    assert {one.data for one in found("truncate", "data")} == {SENT.data[:end] for end in range(12)}
    assert all(Faults({kind: 1.0})(SENT._replace(data=b"")) for kind in ("corrupt", "garble", "truncate"))
    assert {one.identifier for one in found("wrong_id", "identifier")} == {SENT.identifier ^ 1 << n for n in range(11)}


def test_only_frames_with_one_identifier_are_swapped_and_a_fault_that_is_none_is_refused():
    faults, other = Faults({"reorder": 1.0}), SENT._replace(identifier=0x182)
    assert [faults(SENT), faults(SENT._replace(stamp_ns=8))] == [[], [SENT._replace(stamp_ns=8), SENT]]
    assert [faults(SENT), faults(other), faults(other)] == [[], [SENT], [other, other]]
    assert faults.injected == {"reorder": 2}
    for rates, words in (({"drip": 0.1}, "'drip' is unknown"), ({"drop": 1.001}, "rate"), ({"drop": -1e-3}, "rate")):
        with pytest.raises(ValueError, match=words):
            Faults(rates)
    with pytest.raises(LinkCut):
        Faults({"cut": 1.0})(SENT)
