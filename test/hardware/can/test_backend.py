"""The driver's side against the emulated board and against the firmware core, frame by frame, on a clock that the test
moves."""

import contextlib
import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from can_boards import BARE, CLASSIC, FD, FOREIGN, PERIOD, SPLIT, STAGE, START
from forgery import forged
from surveys import GUIDE

from straightcomp_ros.hardware.can.backend import CanHardware
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator import Board
from straightcomp_ros.hardware.can.frames import BoardFault, Command
from straightcomp_ros.hardware.can.hub import ERROR, FD_FRAME, Frame
from straightcomp_ros.hardware.can.sample_numbers import BLOCK
from straightcomp_ros.hardware.interface import HardwareError, State
from straightcomp_ros.hardware.simulated import SimulatedParameters
from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint, forward_and_back, jog
from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.safety.faults import Fault
from trials.can import FirmwareBoard

TIMEOUT = 0.005


class World:
    """Host and board on a bus without delay; ``to_board`` and ``to_host`` may be cut, frames be ``unreceived``, and the
    bus not be ``open``. A ``welded`` board reads each "off" as "on"."""

    def __init__(self, parameters):
        self.now = START
        self.to_board = self.to_host = self.open = True
        self.welded, self.board = False, None
        self.unreceived, self._programs = set(), contextlib.ExitStack()
        self.parameters = parameters
        self.wire = parameters.make_wire()
        self.host = CanHardware(parameters, STAGE, lambda: self.now, self._link)
        self.host.start(self.now)
        self.power_up()
        self.commands = True
        self.samples = []

    def _link(self, parameters, identifiers, receive, clock):
        self._receive, self._identifiers = receive, identifiers
        return SimpleNamespace(
            start=lambda: None, send=self._from_host, problem="", openings=1, transmit_full=0, overloads=0, log=None
        )

    def power_up(self):
        kind = FirmwareBoard if self.parameters.firmware else Board
        simulated = SimulatedParameters(command_timeout=TIMEOUT)
        self.board = kind(self.parameters, simulated, STAGE, GUIDE, self._from_board)
        self._programs.callback(self.board.close)
        self.board.start(self.now)

    def close(self):
        self._programs.close()

    def _from_host(self, identifier, payload, *, fd):
        if self.to_board and self.open and self.board:
            if self.welded:
                payload = self.wire.command.pack(self.wire.command.unpack(payload)._replace(enable=True))
            self.board.receive(identifier, payload, self.now)
        return self.open

    def _from_board(self, identifier, payload, fd):
        if self.to_host and identifier in set(self._identifiers) - self.unreceived:
            self._receive(Frame(self.now, identifier, FD_FRAME if fd else 0, payload), self.now + 100_000)

    def opened(self, problem=""):
        """The bus is open, or takes nothing for this ``problem``."""
        self.open, self.host._link.problem = not problem, problem

    def run(self, seconds, current=0.0):
        for _ in range(round(seconds * 2000)):
            self.now += PERIOD
            if self.board:
                self.board.cycle(self.now)
            samples = self.host.read(self.now)
            self.samples += [sample for sample, _ in samples]
            if self.commands and samples:
                self.host.write(current, self.now, samples[-1][0].stamp_ns)

    def on(self):
        self.run(0.2)
        self.host.enable()
        self.run(0.02)
        assert self.host.state is State.ON and self.board.amplifier is State.ON
        return self

    def off_again(self):
        """After a fault: reset, and on anew."""
        self.to_board = True
        self.host.reset_fault()
        self.run(0.05)
        assert self.board.amplifier is State.OFF and self.host.state is State.OFF and self.host.fault is None
        self.on()

    def command(self, alive, enable, reset=False, current=0.0, echo=None, frames=None):
        """The board gets a command; without ``echo`` it answers the newest sample."""
        frames, echo = frames or self.wire.command, self.board.counter if echo is None else echo
        command = Command(alive % 15, enable, reset, current, echo % (self.wire.echo_modulus or 1))
        self.board.receive(frames.identifier, frames.pack(command), self.now)

    def caught(self):
        """From now on the commands go into this list instead of onto the bus."""
        commands = []

        def send(identifier, payload, *, fd):
            frames = self.wire.command
            assert identifier == frames.identifier and fd is frames.fd
            commands.append(frames.unpack(payload))
            return True

        self.host._link.send = send
        return commands


@pytest.fixture(params=["emulator, classic", "firmware, fd"])
def world(request):
    """A board of each make, and a bus of each kind; emulator and firmware send the same on either."""
    can = CLASSIC
    if request.param == "firmware, fd":
        can = replace(FD, firmware=str(request.getfixturevalue("firmware") / "board_posix"))
    with contextlib.closing(World(can)) as made:
        yield made


@pytest.fixture
def running(world):
    return world.on()


@pytest.mark.parametrize("can", [CLASSIC, FD, FOREIGN, SPLIT], ids=["classic", "fd", "foreign", "split"])
def test_a_board_switches_on_and_off_when_asked_and_off_without_commands_which_it_says_in_its_own_words(can):
    world = World(can)
    world.run(0.2)
    assert world.host.state is State.OFF and math.isnan(world.samples[-1].current)
    world.host.enable()
    # On is what the board has reported.
    assert world.host.state is State.OFF
    world.run(0.02)
    assert world.host.state is State.ON
    world.run(0.05, current=0.2)
    assert world.samples[-1].current == pytest.approx(0.2, abs=0.01)
    assert world.host.applied_current == pytest.approx(0.2)
    assert world.host.lost_samples == world.host.counters()["can_incomplete"] == world.board.refused_commands == 0
    world.to_board = False
    world.run(TIMEOUT + 0.002)
    assert world.board.fault is BoardFault.COMMAND_TIMEOUT and world.board.machine.applied_current == 0.0
    world.run(0.004)
    words = "COMMAND_TIMEOUT" if can in (FOREIGN, SPLIT) else "command timeout"
    # The foreign board's page with the code comes after the one with the state.
    assert world.host.state is State.FAULT and (words in world.host.fault[1]) == (can is not FOREIGN)
    world.run(0.01)
    assert world.host.fault[1] == f"the board reports: {words}"
    assert world.host.counters()["can_board_fault"] == words
    world.off_again()
    world.host.disable()
    assert world.board.amplifier is State.OFF
    world.run(0.05)
    assert world.host.state is State.OFF and world.host.fault is None
    assert world.host.applied_current == 0.0


def silence(world):
    world.to_host, world.host._link.problem = False, "CAN can0: gone"
    # The last frame came 0.1 ms after its sample: 5 ms of silence are complete in the eleventh period.
    world.run(0.005)
    assert world.host.state is State.ON
    world.run(0.0005)
    assert world.host.state is State.FAULT and world.host.fault[0] is Fault.SAMPLE_TIMEOUT
    assert world.host.fault[1].endswith(" ms (CAN can0: gone)")
    world.to_host, world.host._link.problem = True, ""


def no_heartbeat(world):
    world.unreceived = {world.wire.heartbeat.identifier}
    world.run(0.2)
    assert world.host.fault[1].endswith(" ms")


def stopped(world):
    beat = world.wire.heartbeat
    world._receive(Frame(world.now, beat.identifier, 0, beat.pack((4,))), world.now)


def bus_off(world):
    for classes, state in ((0x04, 0x10), (0x40, 0)):
        assert world.host.state is State.ON
        world._receive(Frame(world.now, classes, ERROR, bytes([0, state, 0, 0, 0, 0, 0, 0])), world.now)
        world.run(0.001)


def four_bad_frames(world):
    sample = world.wire.sample
    for _ in range(4):
        world._receive(Frame(0, sample.identifier, FD_FRAME if sample.fd else 0, bytes(sample.size)), world.now)


def too_large_a_current(world):
    world.run(0.001, current=1.5)
    assert world.board.fault is BoardFault.CURRENT_RANGE and world.board.machine.applied_current == 0.0


@pytest.mark.parametrize(
    ("cause", "fault"),
    [
        (silence, "sample for 5."),
        (no_heartbeat, "heartbeat for 150."),
        (World.power_up, "boot-up"),
        (stopped, "heartbeat says state 4, not 5"),
        (bus_off, "bus-off"),
        (four_bad_frames, "checks"),
        (too_large_a_current, "current range"),
        (lambda world: world.command(world.board.command_alive + 1, False), "switched the amplifier off"),
    ],
)
def test_what_must_not_happen_latches_a_fault_of_its_name_until_a_reset(running, cause, fault):
    cause(running)
    running.run(0.001)
    assert fault in running.host.fault[1] and running.board.amplifier is not State.ON
    assert running.host.heartbeat_losses == (cause is no_heartbeat)
    running.unreceived = set()
    running.run(0.3)
    assert fault in running.host.fault[1] and running.board.amplifier is not State.ON
    with pytest.raises(HardwareError, match="latched"):
        running.host.enable()
    running.off_again()


@pytest.mark.parametrize("can", [CLASSIC, FD, FOREIGN, SPLIT], ids=["classic", "fd", "foreign", "split"])
def test_commands_that_stop_are_found_where_the_board_has_no_timeout_and_not_before_a_board_finds_them_itself(can):
    world = World(can)
    world.board.machine.command_timeout_ns = 10**12
    # Nor do they count before the amplifier is on.
    world.commands = False
    world.run(0.2)
    world.commands = True
    world.on().run(0.05, current=0.2)
    for commands, is_open in ((False, True), (True, False)):
        world.commands, world.open = commands, is_open
        world.run(TIMEOUT + 0.012, current=0.2)
        assert world.host.state is State.ON and world.board.amplifier is State.ON
        world.run(0.03 - TIMEOUT - 0.012, current=0.2)
        assert world.host.fault[0] is Fault.COMMAND_TIMEOUT and world.host.applied_current == 0.0
        world.commands = world.open = True
        world.run(0.001)
        assert world.board.amplifier is State.OFF
        world.off_again()


@pytest.mark.parametrize(
    ("lost", "timeout", "fault"),
    [("commands", "command_timeout", Fault.COMMAND_TIMEOUT), ("to_host", "sample_timeout", Fault.SAMPLE_TIMEOUT)],
)
def test_a_single_command_or_sample_that_is_lost_is_no_silence_however_short_the_timeout_and_four_are(
    lost, timeout, fault
):
    world = World(replace(CLASSIC, **{timeout: 1e-4}))
    world.board.machine.command_timeout_ns = 10**12
    world.on()
    for seconds in (*[0.0005] * 10, 0.002):
        assert world.host.fault is None and world.board.amplifier is State.ON
        setattr(world, lost, False)
        world.run(seconds)
        setattr(world, lost, True)
        world.run(0.002)
    assert world.host.fault[0] is fault


@pytest.mark.parametrize(
    ("can", "role", "bridged", "words"),
    [(FOREIGN, "amplifier", 0.14, "no state of the amplifier for"), (SPLIT, "y", 0.004, "no good sample for")],
    ids=["state", "y"],
)
def test_a_state_or_an_axis_that_stops_is_a_fault_at_last_and_samples_without_an_axis_are_not_used(
    can, role, bridged, words
):
    world = World(can).on()
    world.unreceived = {world.wire.homes[role].identifier}
    world.run(bridged)
    assert world.host.state is State.ON
    seen = len(world.samples)
    world.run(0.03)
    assert words in world.host.fault[1] and world.host.heartbeat_losses == 0
    assert world.board.amplifier is State.OFF
    used, unused = len(world.samples) - seen, world.host.counters()["can_incomplete"]
    assert (used == 60, unused > 60) == (role != "y", role == "y")


def test_off_is_obeyed_without_the_other_message_of_its_command_and_a_current_without_its_switches_is_none():
    split = World(SPLIT).on()
    switch, current = split.wire.commands
    for number in range(100):
        split.now += PERIOD
        split.board.cycle(split.now)
        split.command(number, None, None, 0.1, frames=current)
    assert split.board.fault is BoardFault.COMMAND_TIMEOUT
    split.run(0.01)
    split.off_again()
    split.command(7, False, frames=switch)
    assert split.board.amplifier is State.OFF


def test_a_board_that_stays_on_gets_off_in_each_cycle_and_is_a_fault_once_a_state_after_its_time_says_so(running):
    running.welded, within = True, running.host._parameters.answer_timeout
    running.commands = False
    running.host.disable()
    with pytest.raises(HardwareError, match="has not switched its amplifier off"):
        running.host.enable()
    running.run(within - 0.001)
    # At the end of its time it says nothing.
    running.to_host = False
    running.run(0.004)
    assert running.host.fault is None
    running.to_host = True
    running.run(0.001)
    for _ in range(2):
        assert f"did not switch off within {within * 1e3:g} ms" in running.host.fault[1]
        running.host.reset_fault()
        running.run(within - 0.001)
        assert running.host.fault is None and running.board.amplifier is State.ON
        running.run(0.002)
    running.welded = False
    running.run(0.001)
    assert running.board.amplifier is State.OFF
    running.commands = True
    running.off_again()


def test_a_board_that_is_on_when_its_driver_starts_is_switched_off_without_a_fault(running):
    running.to_host = False
    running.host = CanHardware(running.parameters, STAGE, lambda: running.now, running._link)
    running.host.start(running.now)
    # The bus opens long after.
    for _ in range(1000):
        running.now += PERIOD
        running.host.read(running.now)
        running.command(running.board.command_alive + 1, True)
        running.board.cycle(running.now)
    assert running.board.amplifier is State.ON
    running.to_host = True
    running.run(0.3)
    assert running.host.fault is None and running.board.amplifier is State.OFF


@pytest.mark.parametrize("enable", [0b00, 0b11])
def test_patterns_that_are_no_switch_and_damaged_frames_trip_the_board(running, enable):
    frames = running.wire.command
    for alive in range(4):
        payload = forged(frames, frames.pack(Command(alive, False, False, 0.0, 0)), Enable=enable)
        running.board.receive(frames.identifier, payload, running.now)
    assert running.board.fault is BoardFault.COMMAND_CHECK


def test_the_board_refuses_commands_that_are_repeated_or_answer_old_samples(running):
    alive = running.board.command_alive
    running.command(alive, True, current=0.5)
    running.command(alive + 1, True, current=0.5, echo=running.board.counter - 250)
    assert running.board.refused_commands == 2
    running.run(0.001)
    assert running.board.machine.applied_current == 0.0


def test_a_board_that_is_switched_on_by_its_first_command_stays_off(world):
    world.commands = False
    world.run(0.1)
    for alive in range(10):
        world.command(alive, True)
    assert world.board.amplifier is State.OFF


def test_a_command_carries_the_number_of_the_sample_that_it_answers(running):
    running.run(0.4, current=0.1)
    newest, commands = running.board.counter, running.caught()
    for back in (0, 1, 100, 500):
        running.host.write(0.2, running.now, running.samples[-1 - back].stamp_ns)
    # A sample that it does not know, or none, is the newest.
    running.host.write(0.2, running.now, 12345)
    running.host.write(-0.2, running.now)
    modulus = running.wire.echo_modulus
    assert [command.echo for command in commands] == [(newest - back) % modulus for back in (0, 1, 100, 500, 0, 0)]
    assert [command.current for command in commands] == pytest.approx([0.2] * 5 + [-0.2])
    assert {(command.enable, command.reset) for command in commands} == {(True, False)}
    first = commands[0].alive
    assert [command.alive for command in commands] == [(first + number) % 15 for number in range(6)]


@pytest.mark.parametrize("can", [CLASSIC, FD, SPLIT, BARE], ids=["classic", "fd", "split", "bare"])
def test_the_current_of_a_sample_is_the_commanded_one_only_where_the_board_measures_none(can):
    world = World(can).on()
    world.run(0.02, current=0.2)
    assert world.samples[-1].current == pytest.approx(0.2, abs=0.005)
    world.host.write(0.3, world.now)
    assert world.host._receiver.current == pytest.approx(0.3 if can is BARE else 0.2, abs=0.005)
    world.open = False
    world.host.write(-0.4, world.now)
    assert world.host._receiver.current == pytest.approx(0.3 if can is BARE else 0.2, abs=0.005)


@pytest.mark.parametrize("taken", [(), (0,), (1,)], ids=["nothing", "the switches", "the current"])
def test_a_command_that_was_not_sent_as_a_whole_does_not_act_and_counts_only_if_a_message_of_it_was(taken):
    world = World(SPLIT).on()
    world.host.write(0.1, world.now)
    sent, messages = [], {frames.identifier: frames for frames in world.wire.commands}

    def send(identifier, payload, *, fd):
        sent.append(messages[identifier].unpack(payload).alive)
        return [*messages].index(identifier) in taken

    world.host._link.send = send
    for current in (0.2, 0.3):
        world.host.write(current, world.now)
    assert sent == [sent[0]] * 2 + [(sent[0] + len(taken)) % 15] * 2
    assert world.host.applied_current == pytest.approx(0.1)


@pytest.mark.parametrize(("can", "oldest"), [(SPLIT, 12), (FOREIGN, 100), (FD, 100)], ids=["split", "foreign", "fd"])
def test_the_board_answers_samples_within_its_timeout_and_no_more_than_the_echo_tells_from_future_ones(can, oldest):
    # 100 samples; an echo of 15 counts tells fewer.
    found = Board(can, SimulatedParameters(command_timeout=0.05), STAGE, GUIDE, lambda *frame: None)
    found.start(START)
    found.cycle(START + 200 * PERIOD)
    for number, back in enumerate((0, 1, oldest, oldest + 1)):
        echo = (found.counter - back) % found._wire.echo_modulus
        for frames in found._wire.commands:
            found.receive(
                frames.identifier, frames.pack(Command(number, False, False, 0.0, echo)), START + 200 * PERIOD
            )
        assert found.refused_commands == (back > oldest)


def test_the_largest_current_that_fits_its_frame_is_sent_and_off_and_reset_go_out_with_none(running):
    commands = running.caught()
    for current in (3.2767, -3.2767):
        running.host.write(current, running.now)
        with pytest.raises(ValueError, match="does not fit signal"):
            running.host.write(current + math.copysign(1e-4, current), running.now)
    assert [command.current for command in commands] == pytest.approx([3.2767, -3.2767])
    commands.clear()
    running.host.disable()
    running.host.write(0.3, running.now)
    assert [(command.enable, command.reset, command.current) for command in commands] == [(False, False, 0)] * 2
    # Without a fault there is nothing to reset.
    running.host.reset_fault()
    assert len(commands) == 2


def test_a_board_that_does_not_switch_on_within_its_time_is_a_fault(world):
    world.run(0.2)
    world.to_board = False
    world.host.enable()
    within = world.host._parameters.answer_timeout
    world.run(within)
    assert world.host.fault is None
    world.run(0.001)
    assert f"{within * 1e3:g} ms" in world.host.fault[1] and world.host.state is State.FAULT


def test_a_reset_is_repeated_until_the_board_reports_no_fault_or_its_time_is_over(running):
    running.to_board = False
    running.run(TIMEOUT + 0.002)
    assert running.host.state is State.FAULT
    running.commands, commands = False, running.caught()
    running.host.reset_fault()
    within = running.host._parameters.answer_timeout
    running.run(within)
    with pytest.raises(HardwareError, match="has not cleared its fault"):
        running.host.enable()
    assert {(command.enable, command.reset) for command in commands} == {(False, True)}
    assert len(commands) == 1 + round(within * 2000) and running.host.fault is None
    running.run(0.001)
    assert "command timeout" in running.host.fault[1]


def test_a_board_that_is_off_is_switched_on_right_after_a_reset_and_no_command_says_on_and_reset(running):
    running._receive(Frame(running.now, 0x40, ERROR, bytes(8)), running.now)
    running.run(0.02)
    assert running.host.fault and running.board.amplifier is State.OFF
    commands = running.caught()
    running.host.reset_fault()
    running.host.enable()
    running.host.write(0.1, running.now)
    assert [(one.enable, one.reset) for one in commands] == [(False, True), (False, True), (True, False)]


def test_what_is_not_ready_says_what_is_missing(world):
    host = world.host
    assert host.unreferenced == "nothing has come from the board yet"
    with pytest.raises(HardwareError, match="nothing"):
        host.enable()
    world.run(0.2)
    operational = host._receiver.node_state
    for state, seconds, words in ((4, 0, "state 4, not 5"), (operational, 1, "no heartbeat for")):
        host._receiver.node_state = state
        world.now += seconds * 10**9
        with pytest.raises(HardwareError, match=words):
            host.enable()
    assert host.state is State.OFF and host.heartbeat_losses == 0


def test_a_board_at_another_rate_than_the_stage_s_is_named_and_not_switched_on():
    world = World(FD)
    slow = replace(STAGE, rate=1000.0)
    world.board = Board(FD, SimulatedParameters(command_timeout=TIMEOUT), slow, GUIDE, world._from_board)
    world.board.start(world.now)
    world.run(0.5)
    assert not world.samples
    assert world.host.link_problem == "the board samples at about 1000 Hz, 'stage.rate' is 2000 Hz"
    with pytest.raises(HardwareError, match="at about 1000 Hz"):
        world.host.enable()


def test_an_order_to_the_stage_that_cannot_be_sent_is_refused_with_the_reason():
    world, trajectory = World(FD), Trajectory(forward_and_back(MotionParameters(stroke=0.02)))
    real = CanHardware(CanParameters(simulated_stage=False), STAGE, lambda: world.now, world._link)
    world.open = False
    for host, problem, words in (
        (world.host, "", "queue full"),
        (world.host, "CAN can0: no such device", "CAN can0: no such device"),
        (real, "", r"'can\.simulated_stage'"),
    ):
        host._link.problem = problem
        for order in (partial(host.move, trajectory, world.now), partial(host.pace, Pace(hold=True))):
            with pytest.raises(HardwareError, match=words):
                order()


def test_a_pace_that_is_asked_for_before_the_bus_is_open_is_that_of_the_first_motion():
    world = World(FD)
    world.opened("CAN can0 is not open yet")
    world.host.pace(Pace(0.5))
    # The emulator may be in mid-motion.
    for stop in (Pace(hold=True), Pace(end=True)):
        with pytest.raises(HardwareError, match="not open yet"):
            world.host.pace(stop)
    # A hold ends where the emulator knows of it.
    world.opened()
    world.host.pace(Pace(0.5, hold=True))
    world.opened("CAN can0: gone")
    with pytest.raises(HardwareError, match="gone"):
        world.host.pace(Pace(0.5))
    world.opened()
    world.host.pace(Pace(0.5))
    for begin, distance in ((0.0, 0.02), (0.0, 0.01)):
        world.run(0.2)
        world.host.move(Trajectory(jog(STAGE.motion, begin, distance)), world.now)
        world.run(0.1)
        board = world.board.machine.motion
        assert board.pace == world.host.motion.pace == Pace(0.5) and not board.over
        # A running motion cannot be slowed down or held by what is not sent.
        world.opened("CAN can0: gone")
        for pace in (Pace(hold=True), Pace(0.1)):
            with pytest.raises(HardwareError, match="gone"):
                world.host.pace(pace)
        world.opened()
        world.run(2.0)
        assert board.position(world.now) == world.host.motion.position(world.now) == begin + distance
        # The emulator is started again meanwhile, with its stage elsewhere than the driver left it.
        world.power_up()
    assert world.host.motion.number == 2


def test_counters_show_bus_log_and_lost_samples_wherever_they_went(running):
    host = running.host
    counters = host.counters()
    assert counters["can_received"] == len(running.samples) + BLOCK - 1
    assert counters["can_openings"] == 1 and not {"can_link", "can_logged", "can_log"} & set(counters)
    host._link.problem = "gone"
    for problem in ("disk full", ""):
        host._link.log = SimpleNamespace(written=7, dropped=2, problem=problem)
        counters = host.counters()
        assert (counters["can_link"], counters["can_logged"], counters["can_log_dropped"]) == ("gone", 7, 2)
        assert counters.get("can_log", "") == problem
    running.to_host = False
    running.run(0.002)
    running.to_host = True
    running.run(0.02)
    assert host.lost_samples == 4
    host._receiver.overflowed = 10
    assert host.lost_samples == 14


@pytest.mark.parametrize(("taken", "samples", "turns"), [(1, [], 3), (1, [None], 1), (0, [], 1)])
def test_waiting_ends_with_the_first_sample_and_after_three_frames_without_one(taken, samples, turns):
    world, waits = World(FD), []
    world.host._receiver.samples.extend(samples)
    world.host._link.wait = lambda seconds: waits.append(seconds) or taken
    world.host.wait(250_000)
    assert waits == [250e-6] * turns


def test_a_board_that_loses_the_reference_of_x_switches_off_and_says_so_until_it_is_homed(running):
    machine = running.board.machine
    assert running.host.unreferenced == ""
    machine.unreferenced = "the encoder has lost its power"
    running.run(0.02)
    assert running.board.amplifier is State.FAULT and running.board.fault is BoardFault.ENCODER
    assert running.host.state is State.FAULT and running.host.unreferenced == "the board reports no reference"
    machine.unreferenced = ""
    running.run(0.02)
    assert running.host.unreferenced == ""
    running.off_again()


def test_a_simulated_stage_on_can_is_homed_by_a_frame(world):
    world.run(0.2)
    world.board.machine.unreferenced = "it was switched off"
    world.host._link.problem = "CAN can0 is not open yet"
    world.host.pace(Pace(0.5))
    world.host._link.problem = ""
    world.run(0.02)
    assert world.host.unreferenced
    world.host.home(world.now)
    assert world.board.machine.motion.pace == Pace(0.5)
    world.run(0.1)
    assert world.host.unreferenced == ""


def test_a_simulated_stage_on_can_is_held_and_takes_another_trajectory_on_its_way(world):
    motion = STAGE.motion
    world.run(0.2)
    world.host.move(Trajectory(jog(motion, 0.0, 0.05)), world.now)
    world.run(0.3)
    world.host.pace(Pace(hold=True))
    world.run(0.5)
    board = world.board.machine.motion
    assert board.position(world.now) == pytest.approx(world.host.motion.position(world.now), abs=1e-4)
    assert board.condition == world.host.motion.condition == "held"
    world.host.pace(Pace())
    world.run(0.1)
    with pytest.raises(ValueError, match="moves at"):
        world.host.move(Trajectory(jog(motion, world.host.motion.position(world.now), 0.01)), world.now)
    taken = len(world.samples)
    # A sample is due, but not taken yet.
    world.now += PERIOD + PERIOD // 2
    world.host.move(Trajectory([Waypoint(2 * 10**9, 0.001, 0.0)]), world.now)
    assert board.number == world.host.motion.number == 2 and board.moving
    world.run(2.5)
    x = np.array([sample.x for sample in world.samples[taken - 10 :]])
    assert np.abs(np.diff(x, 2)).max() < 2.0 * motion.acceleration * (PERIOD * 1e-9) ** 2 + 4e-7
    assert board.position(world.now) == world.host.motion.position(world.now) == 0.001
