"""Driver and board on a real kernel's CAN: what the bus does to them, and that the driver finds it again.

`-rP` shows what each test counted."""

import contextlib
import gc
import signal
import subprocess
import time

import numpy as np
import pytest
from bus_of_the_kernel import (
    BOARD,
    HOST,
    LAW_STAGE,
    RATE,
    Driver,
    EmulatedBoard,
    ServoDriver,
    lay_cable,
    link,
    parameters,
    remove_cable,
)

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.frame_log import RecordedBus
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.motion import Trajectory, forward_and_back
from straightcomp_ros.parameters.share import share_path

pytestmark = [pytest.mark.live, pytest.mark.nightly]

BUSES = pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])
FOREIGN = str(share_path("config/board_motorola.yaml"))
FD = pytest.mark.parametrize("fd", [True], ids=["fd"])


def sample_id(fd):
    return CanParameters(fd=fd).make_wire().sample.identifier


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """What boards and drivers compile, which takes longer than any timeout: processes that are forked later have it. To
    collect garbage among all that was made before takes seconds here."""
    own = parameters(True, BOARD)
    SimulatedHardware(own.simulated, own.stage, own.guide())
    gc.collect()
    gc.freeze()


@pytest.fixture
def cable():
    lay_cable()
    yield
    with contextlib.suppress(subprocess.CalledProcessError):
        remove_cable()


@pytest.fixture
def start_board(request, fd, cable):
    """Starts boards of one kind on the far end: the emulator, or with ``FIRMWARE_TOO`` the firmware as well."""
    program = getattr(request, "param", "") and request.getfixturevalue("firmware") / request.param
    with contextlib.ExitStack() as stack:
        yield lambda: stack.enter_context(contextlib.closing(EmulatedBoard(fd, program)))


FIRMWARE_TOO = pytest.mark.parametrize("start_board", ["", "board_posix"], ids=["emulator", "firmware"], indirect=True)


@pytest.fixture
def board(start_board):
    return start_board()


@pytest.fixture
def driver(fd, cable):
    with contextlib.closing(Driver(fd)) as driver:
        yield driver


def as_the_board_took_them(samples):
    """Whether each sample is what the machine's encoders read: over CAN FD the emulator sends the truth with it."""
    found = [(sample, truth) for sample, truth in samples if truth is not None]
    differences = [(abs(sample.x - truth.x), abs(sample.y - truth.y)) for sample, truth in found]
    return len(found) > 0.9 * len(samples) and np.max(differences) <= 0.51e-7


@BUSES
@FIRMWARE_TOO
def test_handshake_switching_on_a_stroke_and_switching_off(board, driver, fd):
    driver.switch_on()
    samples, lost = driver.stroke()
    assert driver.hardware.state is State.ON, driver.hardware.fault
    x = [sample.x for sample, _ in samples]
    assert max(x) == pytest.approx(0.1, abs=1e-4) and min(x) == pytest.approx(0.0, abs=1e-6)
    print(f"{len(x)} samples, {lost} lost")
    assert lost < 0.2 * len(x)
    assert not fd or as_the_board_took_them(samples)
    driver.hardware.disable()
    driver.until(lambda: np.isnan(driver.samples[-1][0].current))
    assert driver.hardware.state is State.OFF


@FD
@pytest.mark.parametrize(
    ("file", "program"),
    [(None, ""), (FOREIGN, ""), (FOREIGN, "board_posix")],
    ids=["own frames", "foreign frames", "foreign frames, firmware"],
)
def test_a_stroke_under_the_control_law(request, cable, fd, file, program):
    path = program and request.getfixturevalue("firmware_of")(parameters(fd, BOARD, file).can, program)
    with (
        contextlib.closing(EmulatedBoard(fd, path, file, stage=LAW_STAGE)),
        contextlib.closing(ServoDriver(fd, file, LAW_STAGE)) as driver,
    ):
        driver.switch_on()
        driver.run(0.5)
        samples, lost = driver.stroke()
        errors, motion = driver.true_errors(samples), driver.stage.motion
        xs = np.array([sample.x for sample, _ in samples])
        places = (xs - motion.start) / motion.stroke
        print(f"p-p {np.ptp(errors) * 1e6:.2f} µm, median {np.median(np.abs(errors)) * 1e6:.2f} µm", end=", ")
        print(f"{len(errors)} samples, {lost} lost")
        assert driver.hardware.state is State.ON, driver.hardware.fault
        assert np.ptp(errors) < 0.1e-3
        # Half of the samples have less, for this computer stalls now and then. Without currents friction holds the
        # platform where it was; with a wrong sign the magnets drive it to a stop.
        asked = np.array([driver.map.reference(x)[0] for x in xs])
        assert np.median(np.abs(errors)) < 0.25 * np.median(np.abs(asked - asked[0]))
        # There and back, with samples from each quarter. How many there are is this computer's.
        assert places.max() > 0.99 and np.histogram(places, 4, (0.0, 1.0))[0].all()
        assert len(errors) >= 0.98 * len(places)


def is_found_again(driver, at_least, at_most=10):
    """The board after its interface is there again, and how often the driver's side opened its own."""
    driver.switch_on_after_a_fault()
    openings = driver.count("openings") - 1
    print(f"opened {openings} times")
    assert at_least <= openings <= at_most
    driver.run(0.5)
    assert driver.hardware.state is State.ON and as_the_board_took_them(driver.samples)


@FD
@FIRMWARE_TOO
@pytest.mark.parametrize("end", [HOST, BOARD])
def test_an_interface_that_goes_down_and_up_again_is_found_by_both_sides(board, driver, end):
    driver.switch_on()
    link("set", end, "down")
    # The kernel reports it once, to sending; reading does not get it any more.
    driver.hardware.write(0.0, time.time_ns(), driver.samples[-1][0].stamp_ns)
    driver.until(lambda: driver.faulty() and (end == BOARD or "can_link" in driver.hardware.counters()))
    driver.run(1.0)
    link("set", end, "up")
    is_found_again(driver, *((1, 10) if end == HOST else (0, 0)))


@FD
@FIRMWARE_TOO
def test_an_interface_that_is_deleted_and_made_again_is_found_by_both_sides(board, driver):
    driver.switch_on()
    remove_cable()
    driver.until(lambda: driver.faulty() and "can_link" in driver.hardware.counters())
    assert driver.hardware.counters()["can_link"].startswith("CAN socketcan vxcan0: ")
    lay_cable()
    is_found_again(driver, 1)
    assert "can_link" not in driver.hardware.counters()


STRANGERS = (
    ("{encoder}{fd}0011223344556677{more}", "crc"),
    ("{encoder}#00112233", "length"),
    ("{encoder}#R", "remote"),
    ("20000008#0000000000000000", "error_frames"),
    ("20000004#0010000000000000", "error_passive"),
    ("701#0505", "length"),
)
"""Frames as of cansend, and what counts them; the last is a heartbeat of two bytes."""


@BUSES
def test_each_of_a_strangers_frames_is_counted_and_none_is_used(board, driver, fd):
    driver.switch_on()
    begin, encoder = len(driver.samples), sample_id(fd)
    for frame, counter in STRANGERS:
        text = frame.format(encoder=f"{encoder:X}", fd="##1" if fd else "#", more="0011223344556677" if fd else "")
        before = driver.count(counter)
        for _ in range(3):
            driver.in_parallel("cansend", BOARD, text)
            # A good one comes between: four bad ones in a row would be a fault.
            driver.read_on(1)
        driver.read_on(RATE // 5)
        print(f"{counter}: {driver.count(counter) - before} of 3")
        assert driver.count(counter) == before + 3, counter
    assert driver.hardware.state is State.ON, driver.hardware.fault
    assert {sample.x for sample, _ in driver.samples[begin:]} == {0.0}


@BUSES
@FIRMWARE_TOO
def test_requests_for_the_frames_of_either_side_are_counted_and_nothing_follows(board, driver, fd):
    driver.switch_on()
    wire, begin, requests = CanParameters(fd=fd).make_wire(), len(driver.samples), 20

    def refused():
        return sum(driver.count(name) for name in ("crc", "length", "alive", "state", "implausible"))

    refused_before, before = refused(), driver.hardware.counters()
    for end, identifiers in ((BOARD, wire.identifiers), (HOST, [wire.command.identifier])):
        for identifier in identifiers:
            # At once: taken for commands without content, these would be a fault of the board after four.
            driver.in_parallel("cangen", end, "-R", "-g", "1", "-I", f"{identifier:X}", "-L", "8", "-n", requests)
    driver.read_on(RATE // 2)
    asked = driver.count("remote") - before["can_remote"]
    print(f"{asked} remote frames counted")
    assert asked == requests * len(wire.identifiers) and refused() == refused_before
    assert driver.hardware.state is State.ON, driver.hardware.fault
    assert driver.count("boot_ups") == before["can_boot_ups"]
    assert {sample.x for sample, _ in driver.samples[begin:]} == {0.0}


@FD
def test_what_is_not_for_the_driver_never_reaches_it(board, driver, fd):
    driver.switch_on()
    names = ("received", "crc", "length", "foreign", "error_frames")
    counters = {name: driver.count(name) for name in names}
    encoder = sample_id(fd)
    for text in (f"{encoder:08X}#0011223344556677", f"{encoder + 1:X}#0011223344556677", "7FF#00"):
        driver.in_parallel("cansend", BOARD, text)
    driver.in_parallel("cangen", BOARD, "-g", "0", "-I", "7", "-L", "8", "-n", "5000")
    driver.read_on(RATE // 2)
    assert driver.count("received") > counters["received"] + 10
    assert {name: driver.count(name) for name in names[1:]} == {name: counters[name] for name in names[1:]}
    assert driver.hardware.state is State.ON, driver.hardware.fault


@BUSES
def test_a_full_transmit_queue_is_counted_and_the_board_switches_off(board, driver):
    driver.switch_on()
    before = driver.count("transmit_full")
    driver.in_parallel("tc", "qdisc", "add", "dev", HOST, "root", "netem", "delay", "5s", "limit", "2")
    driver.until(driver.faulty)
    assert driver.hardware.fault[1] == "the board reports: command timeout"
    full = driver.count("transmit_full") - before
    print(f"{full} commands found no room")
    assert full > 10
    driver.in_parallel("tc", "qdisc", "del", "dev", HOST, "root")
    openings = driver.count("openings")
    driver.switch_on_after_a_fault()
    # It was never another bus.
    assert driver.count("openings") == openings


@BUSES
def test_candump_records_the_frames_of_the_drivers_own_log_and_canplayer_plays_that_to_another_driver(
    start_board, fd, tmp_path
):
    theirs, ours, board = tmp_path / "candump.log", tmp_path / "own.log", start_board()
    with subprocess.Popen(["candump", "-L", HOST], stdout=theirs.open("w")) as candump:
        time.sleep(0.5)
        with contextlib.closing(Driver(fd, **{"can.log": str(ours)})) as recorder:
            recorder.until(lambda: recorder.samples)
            recorder.hardware.move(Trajectory(forward_and_back(recorder.stage.motion)), time.time_ns())
            recorder.until(lambda: len(recorder.samples) > 1.5 * RATE)
        candump.send_signal(signal.SIGINT)
    board.kill()

    def payloads(log):
        return [bytes(one.data) for one in RecordedBus(log) if one.arbitration_id == sample_id(fd)]

    own, both = payloads(ours), payloads(theirs)
    # By the last one, in motion: at rest a frame looks like that of a turn of the counter before.
    del both[: both.index(own[-1]) - len(own) + 1]
    print(f"{len(own)} samples in the own log, {len(both)} from its first on in that of candump")
    # Each ends where it was stopped.
    assert min(len(own), len(both)) > RATE
    assert all(foreign == one for foreign, one in zip(both, own, strict=False))

    with contextlib.closing(Driver(fd)) as driver:
        driver.run(0.5)
        driver.in_parallel("canplayer", "-I", ours, f"{BOARD}={HOST}")
        driver.run(0.2)
    then = {sample.x for sample, _ in recorder.samples}
    again = [sample.x for sample, _ in driver.samples]
    print(f"{len(again)} samples again of {len(recorder.samples)}")
    assert max(then) > 1e-3 and len(again) > 0.9 * (len(recorder.samples) - 128) and set(again) <= then
