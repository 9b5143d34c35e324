"""The firmware core against the emulated board: the same frames to the bit, whatever comes, and at whatever time."""

import contextlib
import importlib.util
import random
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from forgery import forged
from hypothesis import given, settings
from hypothesis import strategies as st

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.hardware.can.board import Board
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.firmware import FirmwareBoard
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault, Command
from straightcomp_ros.hardware.can.shipped_wire import shipped_wire
from straightcomp_ros.hardware.can.wire import make_wire
from straightcomp_ros.hardware.interface import HardwareError
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
from straightcomp_ros.model.converters import DriveParameters, EncoderParameters
from straightcomp_ros.model.motion import MotionParameters, forward_and_back
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import MapParameters, load_map

REPOSITORY = Path(__file__).resolve().parents[3]
GUIDE = load_map(MapParameters(file="config/guide_synthetic.csv"))
START = 10**18
STAGE = StageParameters()
CURRENT_COUNT = 1e-4
"""A"""
BUSES = pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])


def made_by_script():
    spec = importlib.util.spec_from_file_location("frames_in_c", REPOSITORY / "scripts" / "make_firmware_frames.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Run:
    """A board with all that it was told and sent; ``program`` is the firmware, without it the board is the emulator."""

    def __init__(self, fd, program=None, stage=STAGE, parameters=None, wire=None):
        can = CanParameters(fd=fd, simulated_stage=True, firmware=str(program or ""))
        self.fd, self.wire = fd, wire or can.make_wire()
        self.emulator = EmulatorFrames(1, self.wire)
        self.sent, self.told, self.currents = [], [], []
        self._next_ns = START
        parameters = parameters or SimulatedParameters()
        send = lambda *frame: self.sent.append(frame)  # noqa: E731
        if program is None:
            machine, largest = SimulatedHardware(parameters, stage, GUIDE), stage.drive.current_range
            self.board = Board(machine, self.wire, largest, send, START, emulator=self.emulator, tells_truth=fd)
        else:
            self.board = FirmwareBoard(can, parameters, stage, GUIDE, send, START)
            self._listen_to(self.board.machine)

    def command(self, alive, enable, reset, current, back=0):
        """Payload of a command that answers the sample ``back`` before the newest; ``current`` in counts."""
        echo = (self.board.counter - back) % self.wire.echo_modulus
        return self.wire.command.pack(Command(alive, bool(enable), bool(reset), current * CURRENT_COUNT, echo))

    def _listen_to(self, machine):
        """The machine behind the firmware integrates a current later than it is asked for."""
        write, disable = machine.write, machine.disable
        self._asked = 0.0

        def asked(current, at_ns):
            self._asked = current
            write(current, at_ns)

        def switched_off():
            self._asked = 0.0
            disable()

        machine.write, machine.disable = asked, switched_off

    def cycle(self, at_ns):
        self.told.append(("cycle", at_ns))
        self.board.cycle(at_ns)
        firmware = isinstance(self.board, FirmwareBoard)
        self.currents.append(self._asked if firmware else self.board.machine.applied_current)

    def cycle_until(self, at_ns):
        """Each sample by itself: one that the emulator takes late, with others, reports the state after all of them."""
        for now in range(self._next_ns, at_ns + 1, STAGE.period_ns):
            self.cycle(now)
            self._next_ns = now + STAGE.period_ns

    def receive(self, identifier, payload, at_ns):
        self.told.append(("receive", identifier, payload, at_ns))
        self.board.receive(identifier, payload, at_ns)

    def told_as(self, other):
        """Tell this board what another was told."""
        for call, *arguments in other.told:
            getattr(self, call)(*arguments)
        return self

    def close(self):
        if isinstance(self.board, FirmwareBoard):
            self.board.close()


@contextlib.contextmanager
def repeated(reference, program, **options):
    with contextlib.closing(Run(reference.fd, program, **options)) as run:
        yield run.told_as(reference)


def bad_loop(fd, stage=STAGE, samples=3000, seed=1, wire=None):
    """The closed loop on a moving stage over a bus that loses, damages and repeats; off, on and reset in between."""
    run, chance = Run(fd, stage=stage, wire=wire), random.Random(seed)
    servo, period = Servo(make_law(ControlParameters(), stage)), stage.period_ns
    motion = MotionParameters(stroke=0.05, settle=0.1)
    for frame in run.emulator.stage_payloads(forward_and_back(motion)):
        run.receive(*frame, START)
    largest = round(stage.drive.largest_current / CURRENT_COUNT)
    silent_until = 0
    for k in range(samples):
        now = START + k * period
        before = len(run.sent)
        run.cycle(now)
        frame = encoders(run, before)[-1]
        command = servo.step(now, frame.y, frame.current or 0.0, (0,) * 3)
        silent_until = k + chance.randrange(30) if chance.random() < 0.005 else silent_until
        if k < silent_until or chance.random() < 0.05:
            continue
        on = k > 20 and k % 301 > 15
        counts = max(-largest, min(largest, round(command.current / CURRENT_COUNT))) if command else 0
        if chance.random() < 0.0005:
            counts = largest + 100
        payload = run.command(k % 15, on, not on, counts)
        if chance.random() < 0.01:
            payload = bytes((*payload[:-1], payload[-1] ^ 1 << chance.randrange(8)))
        for _ in range(1 + (chance.random() < 0.01)):
            run.receive(run.wire.command.identifier, payload, now + chance.randrange(round(1.4 * period)))
    return run


@BUSES
@pytest.mark.parametrize("program", ["board_posix", "board_sanitized"])
def test_the_firmware_sends_the_emulators_frames_to_the_bit_over_a_bad_bus(firmware, program, fd):
    reference = bad_loop(fd)
    amplifier = [frame.amplifier for frame in encoders(reference)]
    # The run is worth comparing.
    assert {Amplifier.OFF, Amplifier.ON, Amplifier.FAULT} == set(amplifier) and amplifier.count(Amplifier.ON) > 1000
    with repeated(reference, firmware / program) as run:
        assert run.sent == reference.sent and run.currents == reference.currents
        assert run.board.refused_commands == reference.board.refused_commands > 20


def encoders(run, begin=0):
    sample = run.wire.sample
    return [sample.unpack(data) for identifier, data, _ in run.sent[begin:] if identifier == sample.identifier]


def states(run):
    return [(frame.amplifier, frame.fault) for frame in encoders(run)]


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
def test_on_other_stages_too(firmware, stage):
    reference = bad_loop(True, stage)
    with repeated(reference, firmware / "board_posix", stage=stage) as run:
        assert run.sent == reference.sent and run.currents == reference.currents


def test_with_a_holding_law_in_float_a_current_differs_by_one_step_of_the_converter_at_most(firmware):
    reference = bad_loop(True)
    with repeated(reference, firmware / "board_float") as run:
        differences = [abs(a - b) for a, b in zip(run.currents, reference.currents, strict=True)]
        assert max(differences) <= 1.001 * STAGE.drive.current_step
        assert states(run) == states(reference)


def test_a_count_between_two_of_the_frames_is_rounded_to_one_of_them(firmware):
    stage = StageParameters(encoder=EncoderParameters(x_resolution=5e-8, y_resolution=5e-8))
    reference = bad_loop(True, stage, samples=1000)
    # In floating point a tie is none, or is one that is not: x may differ by a count, and y, which has no ties of its
    # own where the platform rests.
    with repeated(reference, firmware / "board_posix", stage=stage) as run:
        for own, others in zip(encoders(run), encoders(reference), strict=True):
            assert abs(own.x - others.x) < 1.01e-7 and abs(own.y - others.y) < 1.01e-7
            assert own._replace(x=0, y=0) == others._replace(x=0, y=0)


@st.composite
def telling(draw):
    """What a board is told, with every kind of nonsense: (time since the last call in ns, frame or None)."""
    command = st.tuples(
        st.integers(0, 14),
        st.sampled_from([0, 1, 1, 2, 2, 2, 3]),
        st.sampled_from([0, 1, 1, 1, 2, 3]),
        st.integers(-32767, 32767) | st.integers(-200, 200),
        st.integers(-3, 260),
    )
    noise = st.tuples(st.sampled_from([0x200, 0x201, 0x301, 0x302, 0x7FF]), st.binary(max_size=16))
    waits = st.sampled_from([0, 1, 100_000, 250_000, 500_000, 500_000, 2_000_000, 7_000_000])
    return draw(st.lists(st.tuples(waits, st.none() | command | noise), min_size=1, max_size=80))


@settings(max_examples=60)
@given(told=telling(), fd=st.booleans())
def test_nothing_that_it_is_told_makes_the_firmware_differ_from_the_emulator(firmware, told, fd):
    reference, now = Run(fd), START
    waiting = 0
    for wait, frame in told:
        now += wait
        if frame is None or waiting == 15:
            # The emulator's queue has no end; the firmware's has, see below.
            reference.cycle_until(now)
            waiting = 0
        elif len(frame) == 5:
            waiting += 1
            alive, enable, reset, current, back = frame
            payload = reference.command(alive, False, False, current, back)
            payload = forged(reference.wire.command, payload, Enable=enable, ResetFault=reset)
            reference.receive(reference.wire.command.identifier, payload, now)
        else:
            reference.receive(*frame, now)
    reference.cycle_until(now + 10_000_000)
    with repeated(reference, firmware / "board_sanitized") as run:
        assert run.sent == reference.sent and run.currents == reference.currents
        assert run.board.refused_commands == reference.board.refused_commands
        assert (run.board.amplifier, run.board.fault) == (reference.board.amplifier, reference.board.fault)


def test_of_more_commands_than_can_wait_the_last_are_refused_and_counted(firmware):
    with contextlib.closing(Run(True, firmware / "board_sanitized")) as run:
        run.cycle(START)
        for number in range(20):
            payload = run.command(number % 15, number > 0, False, number)
            run.receive(run.wire.command.identifier, payload, START + 1)
        assert run.board.refused_commands == 4 and run.board.amplifier is Amplifier.ON
        run.cycle(START + 2 * STAGE.period_ns)
        # The sixteenth was the last that had room: number 15, of 15 counts, in steps of the converter.
        assert run.currents[-1] == STAGE.drive.converted(15 * CURRENT_COUNT)


@BUSES
def test_the_sample_counter_wraps_as_the_emulators_does(firmware, tmp_path, fd):
    dbc, limits = (
        (REPOSITORY / name).read_text() for name in ("config/straightcomp.dbc", "firmware/generated/wire_limits.h")
    )
    (tmp_path / "short.dbc").write_text(dbc.replace("4026531839", "3839"))
    (tmp_path / "wire_limits.h").write_text(limits.replace("4026531840", "3840"))
    program = tmp_path / "board"
    sources = [str(path) for folder in ("core", "posix") for path in (REPOSITORY / "firmware" / folder).glob("*.c")]
    include = [f"-I{path}" for path in (tmp_path, *(REPOSITORY / "firmware" / name for name in ("core", "generated")))]
    generated = str(REPOSITORY / "firmware" / "generated" / "wire.c")
    compiler = shutil.which("cc") or "gcc"
    command = [compiler, "-std=c99", "-D_GNU_SOURCE", *include, *sources, generated, "-o", str(program)]
    subprocess.run(command, check=True)
    wire = make_wire(str(tmp_path / "short.dbc"), shipped_wire(fd), 1, fd)
    reference = bad_loop(fd, samples=5000, wire=wire)
    assert reference.board.counter == 4999 - 3840
    with repeated(reference, program, wire=wire) as run:
        assert run.sent == reference.sent


def test_a_command_timeout_is_reported_at_the_sample_at_which_the_emulator_reports_it(firmware):
    parameters = SimulatedParameters(command_timeout=0.02)
    reference = Run(True, parameters=parameters)
    for k in range(2):
        reference.cycle_until(START + k * STAGE.period_ns)
        payload = reference.command(k, k == 1, False, 100)
        reference.receive(reference.wire.command.identifier, payload, START + k * STAGE.period_ns + 1000)
    reference.cycle_until(START + 100_000_000)
    with repeated(reference, firmware / "board_sanitized", parameters=parameters) as run:
        assert run.sent == reference.sent and run.board.fault is BoardFault.COMMAND_TIMEOUT


def test_the_frames_in_c_are_those_of_the_dbc():
    """Remedy: python scripts/make_firmware_frames.py"""
    script = made_by_script()
    version = re.compile(r"generated by cantools version (\S+)\.$", re.MULTILINE)
    for name, text in script.texts().items():
        written = (script.FOLDER / name).read_text(encoding="utf-8")
        own, others = version.search(text), version.search(written)
        if own and own[1] != others[1]:
            pytest.skip(
                f"NOT TESTED: {name} is of cantools {others[1]}, this is {own[1]}, which may write it differently"
            )
        assert written == text, name


def test_a_program_that_is_not_there_or_is_told_too_little_says_so(firmware, tmp_path, capfd):
    make = lambda program: FirmwareBoard(  # noqa: E731
        CanParameters(firmware=str(program)), SimulatedParameters(), STAGE, GUIDE, lambda *_: None, START
    )
    with pytest.raises(HardwareError, match=r"firmware '.*nothing' cannot be started: No such file"):
        make(tmp_path / "nothing")
    for arguments, message in (
        ([], "argument machine=... is missing"),
        (["nonsense=1"], "argument 'nonsense=1' is not known, or no number"),
        (["node=one"], "argument 'node=one' is not known, or no number"),
        (["node"], "argument 'node' is not known, or no number"),
    ):
        done = subprocess.run([firmware / "board_posix", *arguments], capture_output=True, text=True, timeout=60)
        assert done.returncode == 1 and done.stderr == f"board_posix: {message}\n"


def test_a_configuration_that_is_not_allowed_is_refused(firmware, capfd):
    with pytest.raises(HardwareError, match="has ended with code 1"):
        FirmwareBoard(
            CanParameters(firmware=str(firmware / "board_posix")),
            SimulatedParameters(),
            replace(STAGE, drive=DriveParameters(dac_range=1e-5)),
            GUIDE,
            lambda *_: None,
            START,
        )
    assert "the configuration is not allowed" in capfd.readouterr().err
