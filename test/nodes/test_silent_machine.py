"""Why a driver does not switch on: its machine sends no samples, or no controller answers them; what it watches of
samples with the amplifier on and off; where its stage stands, and which motions it takes."""

import math
from contextlib import closing, contextmanager
from unittest.mock import Mock

import numpy as np
import pytest
from participant import spun
from rclpy.action import CancelResponse
from surveys import one_run

from straightcomp_ros.hardware.can.emulator import Board
from straightcomp_ros.hardware.interface import HardwareError, Sample
from straightcomp_ros.model.motion import Trajectory, Waypoint
from straightcomp_ros.model.trajectory_goal import Outcome
from straightcomp_ros.nodes import driver_node
from straightcomp_ros.nodes.driver_node import DriverComponent, make_hardware
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.parameters.node_parameters import DriverNodeParameters
from straightcomp_ros.runtime import trajectory_action
from straightcomp_ros.runtime.loops import now_ns
from straightcomp_ros.runtime.managed import ManagedNode
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.straightness.survey import write_survey


def on_a_hub(tmp_path):
    """Parameters of a driver with a board on a hub that does not run."""
    return {"hardware": "can", "can.interface": "straightcomp_hub", "can.channel": str(tmp_path / "bus")}


@contextmanager
def active(given):
    """The component of an active driver, whose cycles the test plays."""
    node = ManagedNode("driver", DriverNodeParameters, DriverComponent)
    component = DriverComponent(node, from_mapping(DriverNodeParameters, given))
    node.active = True
    with spun(node):
        yield component
        component.close()
        node.streams.close()


@pytest.fixture
def driver(participant, tmp_path, request):
    """That of :func:`active` with a board on a hub that does not run."""
    with active({**on_a_hub(tmp_path), **getattr(request, "param", {"can.command_timeout": 1.0})}) as component:
        yield component


@pytest.fixture
def in_its_own_time(participant):
    """That of :func:`active`, in lockstep."""
    with active({"lockstep": True}) as component:
        yield component


def test_a_driver_without_samples_names_the_machine_and_its_link_and_with_samples_the_controller(participant, driver):
    def refusal():
        answer = participant.enable()
        assert not answer.success
        return answer.message

    no_samples = "no samples come from the machine; CAN straightcomp_hub"
    assert refusal().startswith(no_samples) and refusal().endswith("is not open yet")
    # Such a board has not said either whether x has a reference.
    driver._newest = Sample(now_ns(), 0.0, 0.0, math.nan)
    assert "no reference" not in refusal() and "is not open yet" in refusal()
    driver._hardware._receiver.referenced = False
    assert refusal() == "x is not referenced: the board reports no reference"
    driver._hardware._receiver.referenced = True
    driver._newest = Sample(now_ns(), 0.0, 0.0, math.nan)
    assert "no fresh command from the controller" in refusal()
    driver._newest = Sample(now_ns() - 1_100_000_000, 0.0, 0.0, math.nan)
    driver._hardware._link.problem = ""
    assert refusal() == "no samples come from the machine"


@pytest.mark.parametrize("driver", [{"stage.rate": 100}], indirect=True)
def test_a_sample_and_its_command_are_fresh_for_three_periods_however_slow_the_stage(driver, monkeypatch):
    now = now_ns()
    monkeypatch.setattr(driver_node, "now_ns", lambda: now)
    monkeypatch.setattr(driver, "_others_command", lambda: False)
    driver._hardware._receiver.referenced = True
    for sample_ms, command_ms, refusal in ((29, 29, ""), (29, 31, "no fresh command"), (31, 29, "no samples")):
        driver._newest = Sample(now - sample_ms * 1_000_000, 0.0, 0.0, math.nan)
        driver._commands.stamp_ns = now - command_ms * 1_000_000
        found = driver._enable_refusal()
        assert found.startswith(refusal) and bool(found) == bool(refusal)


def test_a_driver_that_does_not_reach_its_machine_says_why_once(driver, monkeypatch):
    logged = []
    monkeypatch.setattr(driver._unreachable, "log", logged.append)
    for problem in ("no such device", "no such device", "", "", "bus-off"):
        driver._hardware._link.problem = problem
        driver._watch_slowly()
    assert logged == ["no such device", "bus-off"]


@pytest.mark.parametrize("driver", [{"can.simulated_stage": True}], indirect=True)
def test_a_driver_goes_on_where_the_end_of_a_goal_s_motion_does_not_reach_the_stage(driver, monkeypatch):
    action, handle, answered = driver._action, Mock(), Mock()
    monkeypatch.setattr(trajectory_action, "FollowJointTrajectory", Mock())
    monkeypatch.setattr(trajectory_action, "execute", answered)
    monkeypatch.setattr(action, "goal", Mock(canceled=False))
    monkeypatch.setattr(action, "_handle", handle)
    assert action._cancel(handle) is CancelResponse.REJECT and not action.goal.canceled
    action.report(Outcome("abort", -1, "the bus is gone", end=True), 0.0, 0.0)
    assert action.goal is None and answered.called


@pytest.fixture
def panel(driver, monkeypatch):
    """That of a driver whose machine obeys at once and is always ready."""
    for name in ("enable", "disable", "reset_fault"):
        monkeypatch.setattr(driver._hardware, name, lambda: None)
    monkeypatch.setattr(driver._panel, "_refusal", lambda: "")
    return driver._panel


@pytest.mark.parametrize("fault", [None, Fault.X_JUMP])
def test_after_a_switch_off_neither_the_current_that_has_ended_nor_a_hand_on_the_platform_is_a_fault(
    driver, panel, fault
):
    def findings(heights, current):
        found = []
        for y in heights:
            driver._newest = Sample((driver._newest.stamp_ns if driver._newest else 0) + 500_000, 0.0, y, math.nan)
            found.append(driver._sample_watch.check(driver._newest, current))
        return [one for one in found if one]

    driver._sample_watch.travel = 1e-4
    assert not findings((0.0, 2e-3, 5e-6), 0.0)
    panel._on_enable(True)
    assert not findings([5e-6 + 1e-7 * (k % 2) for k in range(200)], 0.5)
    driver._sample_watch.hold()
    if fault:
        driver._trip(fault, "x jumped")
    else:
        panel._on_enable(False)
    assert not findings([5e-6] * 200 + [2e-3, -2e-3], 0.0)
    panel._on_reset_fault()
    # On again it is watched, wherever it stands.
    panel._on_enable(True)
    assert findings([-2e-3] * 200, 0.5)[0][0] is Fault.Y_FROZEN


def test_a_request_for_what_is_already_so_changes_nothing_of_what_is_watched(driver, panel):
    driver._sample_watch.travel = 3e-6
    panel._on_enable(True)
    samples = [Sample(k * 500_000, 0.0, y, math.nan) for k, y in enumerate((0.0, 2e-6, 4e-6))]
    for sample, again in zip(samples[:2], (lambda: panel._on_enable(True), panel._on_reset_fault), strict=True):
        assert driver._sample_watch.check(sample, 0.0) is None
        again()
    assert driver._sample_watch.check(samples[2], 0.0)[0] is Fault.FOLLOWING_ERROR


def test_a_real_stage_takes_no_motion_and_nothing_of_it_is_computed_before_it_is_refused(driver, monkeypatch):
    monkeypatch.setattr(driver._hardware.motion, "joined", lambda *_: pytest.fail("a board would wait for it"))
    with pytest.raises(HardwareError, match=r"takes no orders over CAN; 'can\.simulated_stage'"):
        driver._begin(Trajectory([Waypoint(10**9, 0.01, 0.0)]))


def test_in_lockstep_a_motion_begins_where_and_when_the_last_one_ended_and_there_is_no_homing(
    participant, in_its_own_time
):
    driver, samples = in_its_own_time, []

    def moved(goal):
        driver._begin(Trajectory([Waypoint(10**9, goal, 0.0)]))
        while driver._lockstep._pending:
            samples.append(driver._newest)
            driver._lockstep.answer(driver._newest.stamp_ns, 0.0)

    for goal in (0.01, 0.0, 0.01):
        moved(goal)
    stamps, x, *_ = np.array(samples).T
    assert np.diff(stamps).min() > 0 and np.abs(np.diff(x)).max() < 2e-5 and x.max() == pytest.approx(0.01, abs=1e-6)
    answer = participant.trigger("driver/home")
    assert not answer.success and "no time passes" in answer.message


@pytest.mark.parametrize(
    ("first", "last", "start", "x"),
    [(0.1, 0.7, 0.2, 0.2), (-0.7, -0.1, -0.7, -0.7), (0.015, 0.6, 0.1, 0.0), (-0.3, 0.3, -0.3, 0.0)],
)
def test_a_simulated_stage_stands_on_its_guide_and_at_zero_if_that_is_there(tmp_path, first, last, start, x):
    def survey(*ends):
        places = np.linspace(*ends, 100)
        write_survey(file := str(tmp_path / f"survey {ends}.csv"), one_run(places, 1e-6 * np.sin(10.0 * places)))
        return file

    stage = {"stage.guide.file": survey(first, last), "stage.motion.start": start, "stage.motion.stroke": 0.1}
    on_a_bus = {**on_a_hub(tmp_path), "can.simulated_stage": True}
    # The true guide may be longer than the map.
    longer = {"simulated.truth.guide": survey(-1.0, 1.0)}
    for given, place in (({}, x), (on_a_bus, x), (longer, x), ({"lockstep": True}, start)):
        with closing(make_hardware(from_mapping(DriverNodeParameters, {**stage, **given}))) as machine:
            assert machine.motion.position(0) == place, given
    board = from_mapping(DriverNodeParameters, {**stage, **on_a_bus})
    emulated = Board(board.can, board.simulated, board.stage, board.guide(), lambda *_: None)
    assert emulated.machine.motion.position(0) == x
