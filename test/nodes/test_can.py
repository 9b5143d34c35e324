"""The graph with the board in a process of its own, and what is left of it when a process is killed."""

import signal
import time
from pathlib import Path

import can
import numpy as np
import pytest
import yaml
from parameters_of_tests import without_priority
from participant import PATIENCE_S, Follower

from straightcomp_ros.bags.reader import read_attachments, read_streams
from straightcomp_ros.cell.demonstration import demonstrate, on_hub
from straightcomp_ros.cell.launcher import COMPOSED, RECORDED, verb_command
from straightcomp_ros.contract import ENCODER
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.frame_log import RecordedBus
from straightcomp_ros.hardware.can.frames import BoardFault
from straightcomp_ros.hardware.can.hub_bus import INTERFACE
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.model.motion import MotionParameters, forward_and_back

pytestmark = [pytest.mark.live, pytest.mark.keeps_time]

RATE = 500
"""Seven processes at 2 kHz are more than a busy computer has for a test."""


@pytest.fixture
def operator(own_domain):
    with Follower("operator") as operator:
        yield operator


@pytest.fixture(params=["", pytest.param("board_posix", marks=pytest.mark.nightly)], ids=["emulator", "firmware"])
def values(request, short_cycle, tmp_path):
    """A graph whose machine is a board on a hub: slow, and patient with a busy computer."""
    short_cycle["stage"]["rate"] = RATE
    # The shipped gains lack margins at this rate; the stroke shows the path of the frames, not the law.
    short_cycle["controller"]["control.margins"] = "warn"
    short_cycle["driver"].update(on_hub(short_cycle, str(tmp_path / "bus")))
    if request.param:
        short_cycle["driver"]["can.firmware"] = str(request.getfixturevalue("firmware") / request.param)
    return without_priority(short_cycle)


class Watch:
    """A node on the bus that follows board and host; ``answered`` is the sample that the newest command answers."""

    def __init__(self, bus, wire):
        self._bus, self._wire, self.answered = bus, wire, None

    def until(self, amplifier):
        """The first encoder frame after a command that has the amplifier in this state."""
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            message = self._bus.recv(1.0)
            if message is not None and message.arbitration_id == self._wire.command.identifier:
                self.answered = self._wire.command.unpack(bytes(message.data)).echo
            elif message is not None and message.arbitration_id == self._wire.sample.identifier:
                frame = self._wire.sample.unpack(bytes(message.data))
                if frame.amplifier is amplifier and self.answered is not None:
                    return frame
        raise AssertionError("the board never did what was waited for")


@pytest.mark.parametrize("composed", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_a_stroke_through_hub_and_board_is_recorded(tmp_path, values, composed):
    result = demonstrate(values, tmp_path, composed=composed)
    figures = result.figures()
    assert figures["expected_samples"] >= RATE * 3
    assert figures["lost_samples"] < 0.05 * figures["expected_samples"]
    record = result.evaluation.record
    assert record.x.max() == pytest.approx(0.1, abs=1e-4)
    # The truth comes over the bus too, each with its sample.
    assert figures["true_pp_um"] > 0
    assert np.abs(record.true_x - record.x).max() <= 0.51e-7 and np.abs(record.true_y - record.y).max() <= 0.51e-7


@pytest.mark.nightly
@pytest.mark.parametrize("driving", ["driver", COMPOSED])
def test_a_killed_board_latches_a_fault_and_a_killed_driver_makes_the_board_switch_off(
    graph, operator, values, tmp_path, driving
):
    frame_log = values["driver"]["can.log"] = str(tmp_path / "frames.log")
    file = tmp_path / "parameters.yaml"
    file.write_text(yaml.safe_dump({f"/**/{node}": {"ros__parameters": values[node]} for node in RECORDED}))
    channel = values["driver"]["can.channel"]
    hub = graph.start_program("hub", verb_command("can", "hub", "--socket", channel))
    board = graph.start_program("board", verb_command("dsp", "--params-file", str(file)))
    bag = tmp_path / "bag"
    names = RECORDED if driving == "driver" else (COMPOSED, "logger")
    processes = {node: graph.start(node, {"output": str(bag)} if node == "logger" else {}, file) for node in names}
    operator.switch_on()
    waypoints = forward_and_back(MotionParameters(stroke=0.3, settle=0.0))
    operator.move(waypoints)
    operator.until(lambda: operator.x > 0.01)
    moved_ns = time.time_ns()

    board.send_signal(signal.SIGKILL)
    log = graph.log(driving)
    operator.until(lambda: "no good sample" in log.read_text() or "no heartbeat" in log.read_text())
    assert not operator.enable().success
    assert all(process.poll() is None for process in [hub, *processes.values()])

    # The second stage knows of no motion: as long as the driver expects one, x that stands still is a fault too.
    operator.until(lambda: time.time_ns() > moved_ns + waypoints[-1].time_ns)
    # On a busy computer the operator still has samples of the first board to read.
    restarted_ns = time.time_ns()
    graph.start_program("second_board", verb_command("dsp", "--params-file", str(file)))
    operator.until(lambda: operator.samples[-1][0] > restarted_ns)
    operator.samples.clear()
    operator.until(lambda: len(operator.samples) > 100)
    assert not operator.enable().success and not operator.amplifier_on()
    assert operator.trigger("driver/reset_fault").success
    operator.switch_on()

    wire = CanParameters(node=values["driver"].get("can.node", 1)).make_wire()
    with can.Bus(interface=INTERFACE, channel=channel, fd=True) as bus:
        watch = Watch(bus, wire)
        # On, and commanded, before the kill: what follows is an answer to it.
        watch.until(State.ON)
        processes[driving].send_signal(signal.SIGKILL)
        frame = watch.until(State.FAULT)
    assert frame.fault == wire.fault_codes[BoardFault.COMMAND_TIMEOUT]
    # By the board's own count, so that a busy computer takes no part. No command acts before the sample it answers.
    assert (frame.counter - watch.answered) / RATE >= values["driver"]["simulated.command_timeout"]
    # What the killed driver had written is there.
    logged = {frame.arbitration_id for frame in RecordedBus(Path(frame_log))}
    assert {*wire.identifiers, wire.command.identifier} <= logged
    assert graph.stop(["logger"]) == {"logger": 0}
    recorded = read_streams(bag, {ENCODER.topic: ENCODER.layout})[ENCODER.topic].stamp
    # From both sides of the board's death.
    assert len(recorded) > RATE / 2 and np.diff(recorded).max() > 0.1e9
    assert "parameters.yaml" in read_attachments(bag)
