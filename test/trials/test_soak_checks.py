"""A soak run's checks, with a stand that answers as the test says: each fails when it must."""

import random
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from straightcomp_ros.cell.launcher import LaunchError
from straightcomp_ros.safety.faults import HELD_UP, Fault
from trials import soak_actions
from trials.soak_actions import Scene
from trials.soak_verdict import Soak
from trials.stand import MOTION, Seen

NOW, SECOND = 2_000_000_000_000_000_000, 10**9


class Stand:
    """A graph at work, as far as its fields are not changed."""

    def __init__(self):
        self.condition, self.fault, self.tripped = "on", None, None
        self.enables = False
        self.signal = lambda name, number: NOW
        self.node = SimpleNamespace(create_subscription=lambda *_: None)
        self.answers = {}
        self.heartbeats = SimpleNamespace(states=dict.fromkeys(("driver", "controller"), "active"))

    def until(self, condition, seconds):
        return condition()

    def spin(self, seconds):
        pass

    def enable(self):
        return self.enables

    def call(self, kind, service, request):
        answer = self.answers.get(service)
        return answer(request) if callable(answer) else answer


@pytest.fixture
def stand(monkeypatch):
    monkeypatch.setattr(soak_actions, "subscribe", lambda *_: None)
    return Stand()


@pytest.fixture
def scene(stand, tmp_path):
    stalls = SimpleNamespace(total_ms=lambda begin, end: 0.0)
    return Scene(stand, random.Random(1), 2000, Soak(1), stalls, tmp_path / "log", ("one.csv",))


def latch(stand, fault):
    stand.condition, stand.fault = "fault", Seen(fault, NOW)


def failures_of(check, *names):
    failures = []
    check(*names, failures)
    return failures


def test_a_fault_that_must_be_latched_must_have_the_right_name_and_keep_the_amplifier_off(scene, stand):
    assert "no fault within 3 s" in failures_of(scene.must_latch, HELD_UP)[0]
    latch(stand, Fault.X_JUMP)
    assert "'x_jump' was latched; allowed: command_timeout" in failures_of(scene.must_latch, HELD_UP)[0]
    latch(stand, Fault.COMMAND_TIMEOUT)
    assert failures_of(scene.must_latch, HELD_UP) == [] and scene.result.faults == {"command_timeout": 1}
    stand.enables = True
    assert "could be switched on" in failures_of(scene.must_latch, HELD_UP)[0]


def test_an_amplifier_that_may_not_be_off_is_a_failure(scene, stand):
    assert failures_of(scene.must_be_on) == []
    stand.condition = "off"
    assert "the amplifier is 'off'" in failures_of(scene.must_be_on)[0]
    assert failures_of(scene.may_latch, HELD_UP)
    latch(stand, Fault.SAMPLE_TIMEOUT)
    assert failures_of(scene.may_latch, HELD_UP) == []
    assert "'sample_timeout' was latched; none may" in failures_of(scene.must_be_on)[0]


def test_a_fault_of_a_machine_that_stood_still_is_counted_apart_and_another_fault_is_not(scene, stand):
    scene._stalls = SimpleNamespace(total_ms=lambda begin, end: 120.0)
    latch(stand, Fault.Y_OUT_OF_RANGE)
    assert failures_of(scene.must_be_on) == [] and scene.result.stalls == {"y_out_of_range": 1}
    latch(stand, Fault.TWO_CONTROLLERS)
    assert failures_of(scene.must_be_on)


def test_no_answer_to_two_requests_ends_the_action(scene):
    with pytest.raises(LaunchError, match="does not answer"):
        scene.ask(None, "driver/enable", None)


def positions(scene, times_s, offset=0.0):
    for time_s in times_s:
        time_ns = round(time_s * SECOND)
        scene._on_position(NOW + time_ns, (MOTION.position(time_ns) + offset, 0.0))


def test_a_motion_begins_where_the_stage_was_seen_to_leave_and_ends_where_it_goes_astray(scene):
    positions(scene, (-0.01, 0.0, 0.01, 0.02, 0.03))
    assert scene.commanded.moving
    positions(scene, (0.5, 1.0, 1.5, 3.0, 3.9))
    assert scene.commanded.moving
    positions(scene, (3.91,), offset=0.02)
    assert not scene.commanded.moving
    ((begin, end),) = scene.commanded.motions
    assert begin == pytest.approx(NOW, abs=3_000_000) and end == NOW + 3_900_000_000


def report(scene, second, samples, written, recording="True"):
    values = {"samples": samples, "written": written, "recording": recording}
    status = DiagnosticStatus(name="logger", values=[KeyValue(key=key, value=str(v)) for key, v in values.items()])
    message = DiagnosticArray(status=[status])
    message.header.stamp.sec = NOW // SECOND % 2**31 + second
    scene._on_diagnostics(message)
    return scene.commanded.recording


def test_a_recording_is_whole_between_two_reports_that_have_all_samples(scene):
    assert not report(scene, 0, 0, 0)
    assert not report(scene, 1, 1000, 6000), "half of the samples"
    assert not report(scene, 2, 3000, 6500), "paused"
    assert report(scene, 3, 5000, 18500)
    scene.interrupt()
    assert not scene.commanded.recording


def test_a_logger_that_does_not_record_is_never_taken_for_one_that_does(scene):
    assert not any(report(scene, second, 2000 * second, 12000 * second, "False") for second in range(3))


def parameters_answer(stand, values):
    stand.answers["logger/get_parameters"] = lambda request: SimpleNamespace(
        values=[Parameter(name, value=values[name]).to_parameter_msg().value for name in request.names]
    )


@pytest.mark.parametrize(
    ("successful", "reason", "taken", "words"),
    [
        (False, "fixed", {}, None),
        (True, "", {}, "took"),
        (False, "", {}, "without a reason"),
        (False, "fixed", {"min_free_bytes": 1000}, "in place of"),
    ],
)
def test_wrong_parameters_must_be_refused_with_a_reason_and_nothing_changed(
    scene, stand, monkeypatch, successful, reason, taken, words
):
    values = {"min_free_bytes": 5, "output": "here"}
    parameters_answer(stand, values)

    def answer(request):
        values.update(taken)
        return SimpleNamespace(result=SetParametersResult(successful=successful, reason=reason))

    stand.answers["logger/set_parameters_atomically"] = answer
    monkeypatch.setattr(soak_actions, "_REFUSED", soak_actions._REFUSED[-1:])
    failures = soak_actions.refused_parameters(scene)
    assert (words is None) == (failures == [])
    assert words is None or words in failures[0]


def test_an_amplifier_that_does_not_go_off_or_not_on_is_a_failure(scene, stand):
    stand.answers["driver/enable"] = SimpleNamespace(success=True, message="")
    assert soak_actions.amplifier_off_and_on(scene) == ["the amplifier is 'on' after it was switched off"]
    assert len(scene.result.enable_s) == 1

    def switched(request):
        stand.condition = "off"
        return SimpleNamespace(success=request.data is False, message="no fresh command")

    stand.answers["driver/enable"] = switched
    (failure,) = soak_actions.amplifier_off_and_on(scene)
    assert "allowed: on within 2 s (no fresh command)" in failure
    assert len(scene.result.enable_s) == 1


@pytest.mark.parametrize(("stall_ms", "failures"), [(0.0, 1), (500.0, 0)])
@pytest.mark.parametrize("action", [soak_actions.amplifier_off_and_on, soak_actions.down_and_up])
def test_a_fault_before_the_amplifier_goes_off_is_a_failure_unless_the_machine_stood_still(
    scene, stand, action, stall_ms, failures, monkeypatch
):
    scene._stalls.total_ms = lambda begin, end: stall_ms
    monkeypatch.setattr(soak_actions, "_change_state", lambda *_: None)
    stand.answers["driver/enable"] = SimpleNamespace(success=True, message="")
    latch(stand, Fault.Y_OUT_OF_RANGE)
    assert len(action(scene)) == failures
    assert scene.result.stalls["y_out_of_range"] == 1 - failures


def test_a_controller_that_does_not_miss_the_samples_is_a_failure(scene, stand):
    assert "has not asked" in failures_of(lambda failures: soak_actions._must_trip(scene, failures))[0]
    stand.tripped = Seen(Fault.MAP_MISSING, NOW)
    assert failures_of(lambda failures: soak_actions._must_trip(scene, failures))
    stand.tripped = Seen(Fault.SAMPLE_TIMEOUT, NOW)
    assert failures_of(lambda failures: soak_actions._must_trip(scene, failures)) == []


def test_a_recorder_that_refuses_is_a_failure(scene, stand):
    stand.answers["logger/split"] = SimpleNamespace(success=False, message="nothing is being recorded")
    assert soak_actions.split(scene) == ["split was refused: nothing is being recorded"]


def test_a_refusal_after_a_lost_answer_is_none(scene, stand):
    answers = [None, SimpleNamespace(success=False, message="nothing is being recorded")]
    stand.answers["logger/stop"] = lambda request: answers.pop(0)
    stand.answers["logger/start"] = SimpleNamespace(success=True, message="")
    assert soak_actions.ACTIONS["another bag"](scene) == []
    assert scene.result.answers_lost == 1


def test_a_node_that_does_not_change_its_state_is_a_failure(scene):
    failures = []
    soak_actions._change_state(scene, "controller", 4, "inactive", failures)
    assert failures == ["controller is active; it must be inactive"]
