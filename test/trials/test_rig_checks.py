"""The checks of the rigs on the running graph, with a stand that answers as the test says: each fails when it must."""

import os
import random
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from straightcomp_ros.cell.launcher import LaunchError
from straightcomp_ros.safety.faults import HELD_UP, Fault
from trials import soak_actions
from trials.faults import TRIALS, Row
from trials.soak_actions import Scene
from trials.soak_verdict import HISTORIES_MB, MEMORY_LIMIT_MB_PER_HOUR, Life, Look, Soak, gaps, look
from trials.stalls import Stalls
from trials.stand import Seen, Stand

NOW, SECOND = 2_000_000_000_000_000_000, 10**9


class FakeStand:
    """A graph at work, as far as its fields are not changed; it waits for nothing."""

    must_not_switch_on = Stand.must_not_switch_on

    def __init__(self):
        self.condition, self.fault, self.tripped = "on", None, None
        self.enables, self.failures, self.answers = False, [], {}
        self.signal = lambda name, number: NOW
        self.node = SimpleNamespace(create_subscription=lambda *_: None)
        self.heartbeats = SimpleNamespace(states=dict.fromkeys(("driver", "controller"), "active"))

    def until(self, condition, seconds=0.0):
        return condition()

    def spin(self, seconds):
        pass

    def enable(self):
        return self.enables

    def call(self, kind, service, request):
        answer = self.answers.get(service)
        return answer(request) if callable(answer) else answer

    def latch(self, fault):
        self.condition, self.fault = "fault", Seen(fault, NOW)

    def failures_of(self, check, *arguments):
        self.failures.clear()
        check(*arguments)
        return list(self.failures)


@pytest.fixture
def stand(monkeypatch):
    monkeypatch.setattr(soak_actions, "subscribe", lambda *_: None)
    return FakeStand()


@pytest.fixture
def scene(stand, tmp_path):
    stalls = SimpleNamespace(total_ms=lambda begin, end: 0.0)
    return Scene(stand, random.Random(1), 2000, Soak(1), stalls, tmp_path / "log", ("one.csv",))


def answer(**fields):
    return SimpleNamespace(**{"success": True, "message": "", **fields})


def test_a_row_of_faults_is_green_only_if_each_was_found_in_time_with_all_that_must_follow():
    def row(injected=2, times_ms=(1.0, 3.0), failures=()):
        made = Row(TRIALS[0])
        made.injected, made.times_ms, made.failures = injected, list(times_ms), list(failures)
        return made.to_display()

    limit = row()["limit_ms"]
    expected = {"name": TRIALS[0].name, "injected": 2, "detected": 2, "median_ms": 2.0, "max_ms": 3.0, "green": True}
    assert expected.items() <= row().items()
    for bad in (
        {"injected": 3},
        {"times_ms": (1.0, limit + 1.0)},
        {"failures": ["not latched"]},
        {"injected": 0, "times_ms": ()},
    ):
        assert not row(**bad)["green"]


def test_a_fault_that_must_be_latched_must_have_the_right_name_and_keep_the_amplifier_off(scene, stand):
    assert "no fault within 3 s" in stand.failures_of(scene.must_latch, HELD_UP)[0]
    stand.latch(Fault.X_JUMP)
    assert "'x_jump' was latched; allowed: command_timeout" in stand.failures_of(scene.must_latch, HELD_UP)[0]
    stand.latch(Fault.COMMAND_TIMEOUT)
    assert stand.failures_of(scene.must_latch, HELD_UP) == [] and scene.result.faults == {"command_timeout": 1}
    stand.enables = True
    assert "could be switched on" in stand.failures_of(scene.must_latch, HELD_UP)[0]


def test_an_amplifier_that_may_not_be_off_is_a_failure(scene, stand):
    assert stand.failures_of(scene.may_latch) == []
    stand.condition = "off"
    assert "the amplifier is 'off'" in stand.failures_of(scene.may_latch)[0]
    assert stand.failures_of(scene.may_latch, *HELD_UP)
    stand.latch(Fault.SAMPLE_TIMEOUT)
    assert stand.failures_of(scene.may_latch, *HELD_UP) == []
    assert "'sample_timeout' was latched; none may" in stand.failures_of(scene.may_latch)[0]
    # One that a computer made that stood still is counted apart, and another fault is not.
    scene._stalls = SimpleNamespace(total_ms=lambda begin, end: 120.0)
    assert stand.failures_of(scene.may_latch) == [] and scene.result.faults_in_stalls == {"sample_timeout": 1}
    stand.latch(Fault.TWO_CONTROLLERS)
    assert stand.failures_of(scene.may_latch)


def test_the_stage_moves_while_its_position_changes(scene, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(soak_actions.time, "monotonic", lambda: now[0])
    assert not scene.moving
    for x, moves in ((1e-3, True), (1.01e-3, True), (1.02e-3, False), (1.1e-3, True)):
        now[0] += 0.4
        scene._on_position(0, (x, 0.0))
        assert scene.moving is moves


def test_a_recording_is_whole_between_two_reports_of_a_recording_logger_that_have_all_samples(scene, monkeypatch):
    def report(second, samples, written, recording="True"):
        values = {"samples": samples, "written": written, "recording": recording}
        status = DiagnosticStatus(name="logger", values=[KeyValue(key=key, value=str(v)) for key, v in values.items()])
        message = DiagnosticArray(status=[status])
        message.header.stamp.sec = NOW // SECOND % 2**31 + second
        scene._on_diagnostics(message)
        return scene._recording_ns

    assert not any(report(second, 2000 * second, 12000 * second, "False") for second in range(3))
    assert not report(3, 0, 0)
    assert not report(4, 1000, 6000), "half of the samples"
    assert not report(5, 3000, 6500), "paused"
    begin = report(6, 5000, 18500)
    assert begin
    monkeypatch.setattr(soak_actions.time, "time_ns", lambda: begin + 5 * SECOND)
    scene.interrupt(before_s=1.0)
    scene.interrupt()
    assert scene.recorded == [(begin, begin + 4 * SECOND)]
    # What was known to be complete before an interruption that reaches further back is nothing.
    scene._recording_ns = begin + 5 * SECOND - 1
    scene.interrupt(before_s=1.0)
    assert len(scene.recorded) == 1


@pytest.mark.parametrize(
    ("spans", "missing"),
    [
        ([(-1.0, 11.0)], []),
        ([(-1.0, 5.0), (5.5, 11.0)], []),
        ([(-1.0, 5.0), (6.0, 8.0)], [(5.0, 1.0), (8.0, 2.0)]),
        ([], [(0.0, 10.0)]),
    ],
)
def test_a_longer_time_without_samples_in_a_recording_that_was_complete_is_missing(spans, missing):
    stamps = [NOW + k * 2_000_000 for begin, end in spans for k in range(round(begin * 500), round(end * 500))]
    found = gaps(np.array(stamps[::-1], np.int64), [(NOW, NOW + 10 * SECOND), (NOW - 5 * SECOND, NOW - 5 * SECOND)])
    assert [((begin - NOW) / SECOND, length) for begin, length in found] == [
        (pytest.approx(begin, abs=0.01), pytest.approx(length, abs=0.01)) for begin, length in missing
    ]


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

    def set_values(request):
        values.update(taken)
        return answer(result=SetParametersResult(successful=successful, reason=reason))

    stand.answers["logger/get_parameters"] = lambda request: answer(
        values=[Parameter(name, value=values[name]).to_parameter_msg().value for name in request.names]
    )
    stand.answers["logger/set_parameters_atomically"] = set_values
    monkeypatch.setattr(soak_actions, "_REFUSED", soak_actions._REFUSED[-1:])
    failures = stand.failures_of(soak_actions.refused_parameters, scene)
    assert (words is None) == (failures == [])
    assert words is None or words in failures[0]


def test_an_amplifier_that_does_not_go_off_or_not_on_is_a_failure(scene, stand):
    stand.answers["driver/enable"] = answer()
    act = soak_actions.amplifier_off_and_on
    assert stand.failures_of(act, scene) == ["the amplifier is 'on' after it was switched off"]
    assert len(scene.result.enable_s) == 1

    def switched(request):
        stand.condition = "off"
        return answer(success=request.data is False, message="no fresh command")

    stand.answers["driver/enable"] = switched
    (failure,) = stand.failures_of(act, scene)
    assert "allowed: on within 2 s (no fresh command)" in failure
    assert len(scene.result.enable_s) == 1


def test_a_driver_that_the_controller_does_not_miss_is_a_failure(scene, stand):
    for tripped, failures in ((None, 1), (Fault.MAP_MISSING, 1), (Fault.SAMPLE_TIMEOUT, 0)):
        stand.tripped = tripped and Seen(tripped, NOW)
        assert len(stand.failures_of(soak_actions._must_react, scene, "driver")) == failures


def test_a_recorder_that_refuses_is_a_failure_unless_an_answer_was_lost_and_two_lost_ones_end_the_action(scene, stand):
    refused = answer(success=False, message="nothing is being recorded")
    stand.answers["logger/split"] = refused
    assert stand.failures_of(soak_actions.split, scene) == ["split was refused: nothing is being recorded"]
    answers = [None, refused]
    stand.answers |= {"logger/stop": lambda request: answers.pop(0), "logger/start": answer()}
    assert stand.failures_of(soak_actions.ACTIONS["another bag"], scene) == []
    assert scene.result.answers_lost == 1
    with pytest.raises(LaunchError, match="does not answer"):
        scene.ask(None, "driver/enable", None)


def test_a_node_that_does_not_change_its_state_is_a_failure(scene, stand):
    failures = stand.failures_of(soak_actions._change_state, scene, "controller", 4, "inactive")
    assert failures == ["controller is active; it must be inactive"]


def life(*looks, every_s=60):
    return Life("driver", 7, [Look(k * every_s * SECOND, *numbers) for k, numbers in enumerate(looks)])


def test_one_descriptor_or_thread_more_at_the_end_is_a_failure_and_a_peak_before_is_none():
    assert life((22, 13, 200.0), (30, 15, 201.0), (22, 13, 202.0)).failures() == []
    assert "23 descriptors after 22" in life((22, 13, 200.0), (23, 13, 200.0)).failures()[0]
    assert "14 threads after 13" in life((22, 13, 200.0), (22, 14, 200.0)).failures()[0]


def test_memory_that_grows_too_fast_for_long_enough_is_a_failure_once_it_is_more_than_histories():
    step = 1.1 * MEMORY_LIMIT_MB_PER_HOUR / 60.0
    grown = [(22, 13, 200.0 + step * minute) for minute in range(12 + round(HISTORIES_MB / step))]
    assert life(*grown[:12]).failures() == []
    assert "grows by 66 MB/h; allowed: 60" in life(*grown).failures()[0]
    assert life(*grown, every_s=5).failures() == []
    assert life(*[(22, 13, 200.0 + 0.8 * step * minute) for minute in range(120)]).failures() == []


def test_a_run_has_passed_only_if_something_was_done_and_nothing_failed():
    done, sound = {"split": 1}, [life((22, 13, 200.0), (22, 13, 200.0))]
    assert not Soak(1).to_display()["passed"]
    assert Soak(1, actions=done, lives=sound).to_display()["passed"]
    for failed in (
        Soak(1, actions=done, lives=sound, failures=["split: the amplifier is 'off'"]),
        Soak(1, actions=done, lives=[life((22, 13, 200.0), (23, 13, 200.0))]),
    ):
        assert not failed.to_display()["passed"] and len(failed.to_display()["failures"]) == 1


def test_a_look_sees_descriptors_that_are_opened_and_threads_that_are_started():
    code = "import threading\nprint(flush=True)\ninput()\nkept = [open('/dev/null') for _ in range(5)]\n"
    code += "kept.append(open('/proc/thread-self/schedstat'))\n"  # it comes and goes with a thread
    code += "for _ in range(3): threading.Thread(target=threading.Event().wait, daemon=True).start()\n"
    code += "print(flush=True)\ninput()\n"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        before = look(process.pid)
        process.stdin.write(b"\n")
        process.stdin.flush()
        process.stdout.readline()
        after = look(process.pid)
        process.kill()
    assert after.descriptors - before.descriptors == 5 and after.threads - before.threads == 3
    with pytest.raises(OSError):
        look(process.pid)


def test_a_stall_is_found_in_the_time_that_it_took_and_those_of_two_cpus_are_not_added_up(tmp_path):
    watch = Stalls(tmp_path, 0)
    watch.files = {0: tmp_path / "a", 1: tmp_path / "b"}
    watch.files[0].write_text("1000000000 20.0\n5000000000 7.5\n6000")
    watch.files[1].write_text("")
    assert watch.total_ms(970_000_000, 979_000_000) == pytest.approx(0.0)
    assert watch.total_ms(970_000_000, 981_000_000) == pytest.approx(20.0)
    assert watch.total_ms(1_000_000_001, 9_000_000_000) == pytest.approx(7.5)
    assert watch.total_ms(0, 9_000_000_000) == pytest.approx(27.5)
    watch.files[1].write_text("1000000000 30.0\n")
    assert watch.total_ms(0, 2_000_000_000) == pytest.approx(30.0)


def test_a_watch_that_is_stopped_for_a_while_has_seen_a_stall(tmp_path):
    with Stalls(tmp_path, 0) as watch:
        time.sleep(2.0)
        begin = time.time_ns()
        for process in watch.processes:
            os.kill(process.pid, signal.SIGSTOP)
        time.sleep(0.3)
        for process in watch.processes:
            os.kill(process.pid, signal.SIGCONT)
        end = time.monotonic() + 30.0
        while watch.total_ms(begin, time.time_ns()) < 200.0 and time.monotonic() < end:
            time.sleep(0.05)
        assert watch.total_ms(begin, time.time_ns()) >= 200.0
    assert all(process.returncode is not None for process in watch.processes)
