"""The firmware core against the emulated board: the same frames to the bit, whatever comes, and at whatever time."""

import contextlib
import math
import random
import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from can_boards import BARE, CLASSIC, FD, FOREIGN, FOREIGN_FILE, SPLIT, STAGE, START
from drawn_dbc import drawn_board
from forgery import forged
from hypothesis import given, settings
from hypothesis import strategies as st
from places import REPOSITORY
from surveys import GUIDE
from tiers import nightly

from scripts import make_firmware_frames
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.hardware.can.board_dbc import OF_BOARD
from straightcomp_ros.hardware.can.can_parameters import CanParameters, WireParameters
from straightcomp_ros.hardware.can.emulator import Board
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frames import Command
from straightcomp_ros.hardware.can.frames_in_c import _real, frames_in_c
from straightcomp_ros.hardware.can.sample_numbers import together
from straightcomp_ros.hardware.interface import HardwareError, State
from straightcomp_ros.hardware.simulated import SimulatedParameters
from straightcomp_ros.model.converters import DriveParameters, EncoderParameters
from straightcomp_ros.model.motion import MotionParameters, forward_and_back
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.stage.description import StageParameters
from trials.can import FirmwareBoard

CURRENT_COUNT = 1e-4
"""A"""


class Pair:
    """The emulator and a firmware that get the same calls; of each what it sent, its currents and its states."""

    def __init__(self, can, program, stage=STAGE):
        self.wire = can.make_wire()
        self.stage_payloads = EmulatorFrames(self.wire).stage_payloads
        self.sent, self.currents, self.states = ([], []), ([], []), ([], [])
        self._next_ns, self._asked = START, 0.0
        given = SimulatedParameters(), stage, GUIDE
        self.board = Board(can, *given, lambda *frame: self.sent[0].append(frame))
        theirs = replace(can, firmware=str(program))
        self.firmware = FirmwareBoard(theirs, *given, lambda *frame: self.sent[1].append(frame))
        self._boards = self.board, self.firmware
        self._listen_to(self.firmware.machine)
        for board in self._boards:
            board.start(START)

    def command(self, number, enable, reset, current, back=0):
        """Identifiers and payloads of the ``number``-th command, which answers the sample ``back`` before the newest;
        ``current`` in counts."""
        echo = (self.board.counter - back) % (self.wire.echo_modulus or 1)
        command = Command(0, bool(enable), bool(reset), current * CURRENT_COUNT, echo)
        return [
            (frames.identifier, frames.pack(command._replace(alive=number % frames.alive_modulus)))
            for frames in self.wire.commands
        ]

    def _listen_to(self, machine):
        """The machine behind the firmware integrates a current later than it is asked for."""
        write, disable = machine.write, machine.disable

        def asked(current, at_ns):
            self._asked = current
            write(current, at_ns)

        def switched_off():
            self._asked = 0.0
            disable()

        machine.write, machine.disable = asked, switched_off

    def cycle(self, at_ns):
        for board, states in zip(self._boards, self.states, strict=True):
            board.cycle(at_ns)
            states.append((board.amplifier, board.fault))
        for currents, current in zip(self.currents, (self.board.machine.applied_current, self._asked), strict=True):
            currents.append(current)

    def lose_the_reference_or_find_it_again(self):
        for board in self._boards:
            board.machine.unreferenced = "" if board.machine.unreferenced else "the encoder has lost its power"

    def cycle_until(self, at_ns):
        """Each sample by itself: one that the emulator takes late, with others, reports the state after all of them."""
        for now in range(self._next_ns, at_ns + 1, STAGE.period_ns):
            self.cycle(now)
            self._next_ns = now + STAGE.period_ns

    def receive(self, *frame):
        for board in self._boards:
            board.receive(*frame)

    def close(self):
        self.firmware.close()

    def judge_equal(self):
        """The firmware has sent the same frames and currents, and refused as many commands."""
        for emulated, own in (self.sent, self.currents, self.states):
            assert emulated == own
        assert self.board.refused_commands == self.firmware.refused_commands

    def encoders(self, board, begin=0):
        """The samples that the emulator (0) or the firmware (1) sent, each from all its frames."""
        count, identifiers = len(self.wire.parts), {frames.identifier for frames in self.wire.parts}
        sent = ((identifier, data) for identifier, data, _ in self.sent[board][begin:] if identifier in identifiers)
        found = [self.wire.reports[identifier].unpack(data) for identifier, data in sent]
        return [together(found[k : k + count]) for k in range(0, len(found), count)]


@pytest.fixture
def pair():
    """``pair(can, program)`` are the two boards with these frames."""
    with contextlib.ExitStack() as stack:
        yield lambda *given: stack.enter_context(contextlib.closing(Pair(*given)))


def bad_loop(run, stage=STAGE, samples=3000):
    """The closed loop on a moving stage over a bus that loses, damages and repeats; off, on and reset in between."""
    chance = random.Random(1)
    servo, period = Servo(make_law(ControlParameters(), stage)), stage.period_ns
    motion = MotionParameters(stroke=0.05, settle=0.1)
    for frame in run.stage_payloads(forward_and_back(motion)):
        run.receive(*frame, START)
    largest = round(stage.drive.largest_current / CURRENT_COUNT)
    silent_until = 0
    for k in range(samples):
        now = START + k * period
        before = len(run.sent[0])
        if k % 1200 in (860, 890):
            run.lose_the_reference_or_find_it_again()
        run.cycle(now)
        frame = run.encoders(0, before)[-1]
        command = servo.step(now, frame.y, frame.current or 0.0, (0,) * 3)
        silent_until = k + chance.randrange(30) if chance.random() < 0.005 else silent_until
        if k < silent_until or chance.random() < 0.05:
            continue
        on = k > 20 and k % 301 > 15
        counts = max(-largest, min(largest, round(command.current / CURRENT_COUNT))) if command else 0
        if chance.random() < 0.0005:
            counts = largest + 100
        back = chance.randrange(13) if chance.random() < 0.03 else 0
        for identifier, payload in run.command(k, on, not on, counts, back):
            if chance.random() < 0.01:
                payload = bytes((*payload[:-1], payload[-1] ^ 1 << chance.randrange(8)))
            for _ in range(1 + (chance.random() < 0.01)):
                run.receive(identifier, payload, now + chance.randrange(round(1.4 * period)))
    return run


@pytest.mark.parametrize("can", [CLASSIC, FD, FOREIGN, SPLIT, BARE], ids=["classic", "fd", "foreign", "split", "bare"])
@pytest.mark.parametrize("program", ["board_sanitized", *nightly(["board_posix"])])
def test_the_firmware_sends_the_emulators_frames_to_the_bit_over_a_bad_bus(pair, firmware_of, program, can):
    # A count of x that lies between two of the frame's is another matter, see below.
    stage = STAGE if can is not BARE else StageParameters(encoder=EncoderParameters(x_resolution=2e-7))
    run = bad_loop(pair(can, firmware_of(can, program), stage), stage)
    amplifier = [amplifier for amplifier, _ in run.states[0]]
    # The run is worth comparing. Without a counter no command is refused as repeated.
    assert {State.OFF, State.ON, State.FAULT} == set(amplifier) and amplifier.count(State.ON) > 1000
    assert run.board.refused_commands > 20 or can is BARE
    run.judge_equal()


def board_with_a_message_for_each_signal():
    """The text of its DBC file, whose counter of samples wraps after 768, and the meaning of its signals."""
    scales, ends = {"x": 1e-7, "y": 1e-7, "current": 1e-4}, {"counter": 767}
    lines, values = ['VERSION "1"', "NS_ :", "BS_:", "BU_: X"], {"protection.sample.alive": "count"}
    for number, role in enumerate(OF_BOARD, 0x101):
        kind = f"32@1- ({scales[role]},0)" if role in scales else "16@1+ (1,0)"
        lines += [f"BO_ {number} of_{role}: 8 X", f' SG_ {role} : 0|{kind} [0|{ends.get(role, 0)}] "" X']
        lines += [' SG_ count : 32|8@1+ (1,0) [0|0] "" X'] * (role == "x")
        values |= {f"{role}.message": f"of_{role}", f"{role}.signal": role}
    lines += ["BO_ 512 order: 8 X", ' SG_ set : 0|16@1- (1E-4,0) [0|0] "" X', ' SG_ on : 16|8@1+ (1,0) [0|0] "" X', ""]
    values |= {"command.message": "order", "command.signal": "set", "enable.signal": "on"}
    return "\n".join(lines), from_mapping(WireParameters, values)


@pytest.mark.parametrize("seed", ["a_message_for_each", 0, *nightly(range(1, 10))])
def test_a_board_with_any_dbc_file_is_the_emulator_to_the_bit_also_when_its_counter_wraps(
    pair, firmware_of, tmp_path, seed
):
    text, meaning = board_with_a_message_for_each_signal() if seed == "a_message_for_each" else drawn_board(seed)
    file = tmp_path / f"drawn_{seed}.dbc"
    file.write_text(text)
    can = CanParameters(dbc=str(file), wire=meaning, fd=seed != "a_message_for_each", simulated_stage=True)
    run = bad_loop(pair(can, firmware_of(can, "board_sanitized")), samples=1500)
    assert [amplifier for amplifier, _ in run.states[0]].count(State.ON) > 300
    assert run.board.counter == 1499 % (run.wire.number_modulus or 1500)
    run.judge_equal()


@pytest.mark.parametrize(
    "stage",
    [
        StageParameters(rate=1000),
        StageParameters(rate=8000, drive=DriveParameters(delay=2.5, dac_bits=16)),
        StageParameters(drive=DriveParameters(delay=0.0, dac_bits=8, dac_range=5.0)),
        StageParameters(encoder=EncoderParameters(x_resolution=1e-6, y_resolution=5e-7)),
        StageParameters(encoder=EncoderParameters(x_resolution=2e-8, y_resolution=4.8828125e-9)),
    ],
    ids=["1 kHz", "8 kHz, 2.5 samples, 16 bit", "no delay, 8 bit", "coarse encoders", "fine encoders"],
)
def test_on_other_stages_too(pair, firmware, stage):
    bad_loop(pair(FD, firmware / "board_posix", stage), stage).judge_equal()


def test_with_a_holding_law_in_float_a_current_differs_by_one_step_of_the_converter_at_most(pair, firmware):
    run = bad_loop(pair(FD, firmware / "board_float"))
    differences = [abs(a - b) for a, b in zip(*run.currents, strict=True)]
    assert max(differences) <= 1.001 * STAGE.drive.current_step
    assert run.states[0] == run.states[1]


def test_a_count_between_two_of_the_frames_is_rounded_to_one_of_them(pair, firmware):
    stage = StageParameters(encoder=EncoderParameters(x_resolution=5e-8, y_resolution=5e-8))
    run = bad_loop(pair(FD, firmware / "board_posix", stage), stage, samples=1000)
    # In floating point a tie is none, or is one that is not: x may differ by a count, and y, which has no ties of its
    # own where the platform rests.
    for own, others in zip(run.encoders(1), run.encoders(0), strict=True):
        assert abs(own.x - others.x) < 1.01e-7 and abs(own.y - others.y) < 1.01e-7
        assert own._replace(x=0, y=0) == others._replace(x=0, y=0)


COMMANDS = st.tuples(
    *(st.integers(0, 14), st.sampled_from([0, 1, 1, 2, 2, 2, 3]), st.sampled_from([0, 1, 1, 1, 2, 3])),
    *(st.integers(-32767, 32767) | st.integers(-200, 200), st.integers(-3, 260)),
)
NOISE = st.tuples(st.sampled_from([0x200, 0x201, 0x301, 0x302, 0x7FF]), st.binary(max_size=16))
WAITS = st.sampled_from([0, 1, 100_000, 250_000, 500_000, 500_000, 2_000_000, 7_000_000])
NONSENSE = st.lists(st.tuples(WAITS, st.none() | COMMANDS | NOISE), min_size=1, max_size=80)
"""What comes to a board: time since the last call in ns, and frame or None."""


@settings(max_examples=60)
@given(calls=NONSENSE, can=st.sampled_from([CLASSIC, FD]))
def test_nothing_that_comes_makes_the_firmware_differ_from_the_emulator(firmware, calls, can):
    waiting, now = 0, START
    with contextlib.closing(Pair(can, firmware / "board_sanitized")) as run:
        for wait, frame in calls:
            now += wait
            if frame is None or waiting == 15:
                # The emulator's queue has no end; the firmware's has, see below.
                run.cycle_until(now)
                waiting = 0
            elif len(frame) == 5:
                waiting += 1
                alive, enable, reset, current, back = frame
                ((_, payload),) = run.command(alive, False, False, current, back)
                payload = forged(run.wire.command, payload, Enable=enable, ResetFault=reset)
                run.receive(run.wire.command.identifier, payload, now)
            else:
                run.receive(*frame, now)
        run.cycle_until(now + 10_000_000)
        run.judge_equal()


def test_of_more_commands_than_can_wait_the_last_are_refused_and_counted(pair, firmware):
    run = pair(FD, firmware / "board_sanitized")
    run.cycle(START)
    for number in range(20):
        (frame,) = run.command(number, number > 0, False, number)
        run.receive(*frame, START + 1)
    assert run.firmware.refused_commands == 4 and run.firmware.amplifier is State.ON
    run.cycle(START + 2 * STAGE.period_ns)
    # The sixteenth was the last that had room: number 15, of 15 counts, in steps of the converter.
    assert run.currents[1][-1] == STAGE.drive.converted(15 * CURRENT_COUNT)


def test_the_frames_in_c_are_those_of_the_dbc():
    """Remedy: python scripts/make_firmware_frames.py"""
    version = re.compile(r"generated by cantools version (\S+)\.$", re.MULTILINE)
    for name, text in make_firmware_frames.texts().items():
        written = (make_firmware_frames.FOLDER / name).read_text(encoding="utf-8")
        own, others = version.search(text), version.search(written)
        if own and own[1] != others[1]:
            pytest.skip(f"NOT TESTED: {name} is of cantools {others[1]}; this is {own[1]}")
        assert written == text, name


def test_a_program_that_is_not_there_or_has_too_few_arguments_says_so(firmware, tmp_path, monkeypatch):
    with pytest.raises(HardwareError, match=r"firmware '.*nothing' cannot be started: No such file"):
        Pair(FD, tmp_path / "nothing")
    (tmp_path / "board").touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(HardwareError, match="firmware 'board' cannot be started: Permission denied"):
        Pair(FD, "board")
    for words in ([], ["nonsense=1"], ["node=one"], ["node"]):
        done = subprocess.run([firmware / "board_posix", *words], capture_output=True, text=True, timeout=60)
        assert done.returncode == 1 and f"argument {repr(words[0]) if words else 'machine=...'} is " in done.stderr


@pytest.mark.parametrize(
    ("can", "stage", "said"),
    [
        (FOREIGN, STAGE, ["'straightcomp.dbc ", "not with those of 'board_motorola.dbc ", "straightcomp can firmware"]),
        (FD, replace(STAGE, encoder=EncoderParameters(x_resolution=1e-14)), ["the configuration is not allowed"]),
    ],
    ids=["frames of another board", "configuration"],
)
def test_a_program_that_is_not_for_this_board_is_refused(firmware, capfd, can, stage, said):
    with pytest.raises(HardwareError, match="has ended with code 1"):
        Pair(can, firmware / "board_posix", stage)
    found = capfd.readouterr().err
    assert all(words in found for words in said)


def test_frames_of_more_messages_than_the_core_has_room_for_are_refused(firmware, tmp_path, capfd):
    wire, program = FD.make_wire(), tmp_path / "board_posix"
    for name, text in frames_in_c([wire]).items():
        count = f".frame_count = {len(wire.reports)}u"
        (tmp_path / name).write_text(text.replace(count, f".frame_count = {len(OF_BOARD) + 1}u"))
    made = ["make", "-C", REPOSITORY / "firmware", program, f"GENERATED={tmp_path}", f"BUILD={tmp_path}"]
    subprocess.run(made, check=True, timeout=300)
    with pytest.raises(HardwareError, match="has ended with code 1"):
        Pair(FD, program)
    assert "the configuration is not allowed" in capfd.readouterr().err


def test_the_verb_writes_the_frames_of_a_stage_and_says_how_they_are_built(tmp_path, verb):
    folder, file = tmp_path / "frames (2)", tmp_path / "file"
    said = verb("can", "firmware", FOREIGN_FILE, "-o", folder).err
    assert f"make -C firmware GENERATED='{folder}' BUILD='{folder}/build'" in said
    texts = frames_in_c([FOREIGN.make_wire()])
    assert {file.name: file.read_text() for file in folder.glob("*.[ch]")} == texts
    found = verb("can", "firmware", FOREIGN_FILE, "-o", folder, "--json")
    assert found.code == 0 and found.json["source"] == FOREIGN.make_wire().source()
    file.touch()
    code, _, said = verb("can", "firmware", FOREIGN_FILE, "-o", file)
    assert code == 2 and f"'{file}': File exists" in said


def test_a_limit_beyond_the_boards_numbers_is_the_largest_of_them():
    largest = float(np.finfo(np.float32).max)
    for limit in (math.inf, -1e300, 1e38):
        assert float(_real(limit).removeprefix("(board_real)")) == max(-largest, min(limit, largest))
