"""The checks of the rigs on the running graph, with a stand that answers as the test says: each fails when it must."""

import os
import random
import signal
import subprocess
import sys
import time
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from straightcomp_ros.cell.launcher import LaunchError
from straightcomp_ros.safety.faults import HELD_UP, Fault
from trials import soak as soak_run
from trials import stalls
from trials.faults import row_of, trials_of
from trials.soak import Soak
from trials.soak_verdict import HISTORIES_MB, MEMORY_LIMIT_MB_PER_HOUR, Look, gaps, grown, look
from trials.stand import Seen, Stand

NOW, SECOND = 2_000_000_000_000_000_000, 10**9


class FakeStand:
    """A graph at work, as far as its fields are not changed; it waits for nothing."""

    must_not_switch_on, fail, set = Stand.must_not_switch_on, Stand.fail, Stand.set

    def __init__(self):
        self.condition, self.fault, self.tripped = "on", None, None
        self.enables, self.failures, self.answers, self.about = False, [], {}, ""
        self.x, self.answers_lost, self.names = 0.0, 0, ("driver", "feedforward", "controller", "logger")
        self.restart = lambda name: None
        self.signal = lambda name, number: NOW
        self.node = SimpleNamespace(create_subscription=lambda *_: None)
        self.heartbeats = SimpleNamespace(states=dict.fromkeys(("driver", "controller"), "active"))

    def until(self, condition, seconds=0.0):
        self.spin(seconds)
        return condition()

    def switch_on(self):
        pass

    def move(self):
        pass

    def spin(self, seconds):
        pass

    def enable(self):
        return self.enables

    def call(self, kind, service, request, repeated=True):
        answer = self.answers.get(service)
        return answer(request) if callable(answer) else answer

    def latch(self, fault):
        self.condition, self.fault = "fault", Seen(fault, NOW)

    def failures_of(self, check, *arguments):
        self.failures.clear()
        check(*arguments)
        return list(self.failures)


@pytest.fixture
def stand():
    return FakeStand()


@pytest.fixture
def soak(stand):
    return Soak(stand, random.Random(1), 2000, lambda begin, end: 0.0, ("one.csv",))


def answer(**fields):
    return SimpleNamespace(**{"success": True, "message": "", **fields})


def test_a_row_of_faults_is_green_only_if_each_was_found_in_time_with_all_that_must_follow():
    trial = trials_of(False)[0]

    def row(injected=2, times_ms=(1.0, 3.0), failures=()):
        return row_of(trial, injected, times_ms, failures)

    limit = row()["limit_ms"]
    expected = {
        "name": trial.name,
        "injected": 2,
        "detected": 2,
        "median_ms": 2.0,
        "max_ms": 3.0,
        "green": True,
    }
    assert expected.items() <= row().items()
    for bad in (
        {"injected": 3},
        {"times_ms": (1.0, limit + 1.0)},
        {"failures": ["not latched"]},
        {"injected": 0, "times_ms": ()},
    ):
        assert not row(**bad)["green"]


def test_a_fault_that_must_be_latched_must_have_the_right_name_and_keep_the_amplifier_off(soak, stand):
    soak.killable, kill = ["controller"], partial(stand.failures_of, soak_run.ACTIONS["SIGKILL"], soak)
    assert "command_timeout was not found" in kill()[0]
    stand.latch(Fault.X_JUMP)
    assert "command_timeout was not found" in kill()[0]
    for fault in (Fault.COMMAND_TIMEOUT, Fault.Y_OUT_OF_RANGE):
        stand.latch(fault)
        assert kill() == [] and stand.failures_of(soak.check, HELD_UP) == [] and soak.counts["faults"][fault.label] == 1
    stand.enables = True
    assert "could be switched on" in kill()[0]


def test_an_amplifier_that_may_not_be_off_is_a_failure(soak, stand):
    assert stand.failures_of(soak.check) == []
    stand.condition = "off"
    assert "the amplifier is 'off'" in stand.failures_of(soak.check)[0]
    assert stand.failures_of(soak.check, HELD_UP)
    stand.latch(Fault.SAMPLE_TIMEOUT)
    assert stand.failures_of(soak.check, HELD_UP) == []
    assert "'sample_timeout' was latched; none may" in stand.failures_of(soak.check)[0]
    # One that a computer made that stood still is counted apart, and another fault is not.
    soak._stalled = lambda begin, end: 120.0
    assert stand.failures_of(soak.check) == [] and soak.counts["faults_in_stalls"] == {"sample_timeout": 1}
    stand.latch(Fault.TWO_CONTROLLERS)
    assert stand.failures_of(soak.check)


def test_a_stage_that_does_not_move_is_not_back_to_work(soak, stand, monkeypatch):
    monkeypatch.setattr(soak_run, "_BACK_S", 0.0)
    soak._recording_ns = 1
    with pytest.raises(LaunchError, match="the stage does not move"):
        soak.back_to_work()
    stand.move = stand.spin = lambda *_: setattr(stand, "x", stand.x + 1e-3)
    soak.back_to_work()
    assert len(soak.back_s) == 1


def test_a_recording_is_whole_between_two_reports_of_a_recording_logger_that_have_all_samples(soak, monkeypatch):
    def report(second, samples, written, recording="True"):
        values = {"samples": samples, "written": written, "recording": recording}
        status = DiagnosticStatus(name="logger", values=[KeyValue(key=key, value=str(v)) for key, v in values.items()])
        message = DiagnosticArray(status=[status])
        message.header.stamp.sec = NOW // SECOND % 2**31 + second
        soak._on_diagnostics(message)
        return soak._recording_ns

    assert not any(report(second, 2000 * second, 12000 * second, "False") for second in range(3))
    assert not report(3, 0, 0)
    assert not report(4, 1000, 6000), "half of the samples"
    assert not report(5, 3000, 6500), "paused"
    begin = report(6, 5000, 18500)
    assert begin
    monkeypatch.setattr(soak_run.time, "time_ns", lambda: begin + 5 * SECOND)
    soak.interrupt(before_s=1.0)
    soak.interrupt()
    assert soak.recorded == [(begin, begin + 4 * SECOND)]
    # What was known to be complete before an interruption that reaches further back is nothing.
    soak._recording_ns = begin + 5 * SECOND - 1
    soak.interrupt(before_s=1.0)
    assert len(soak.recorded) == 1


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
    soak, stand, monkeypatch, successful, reason, taken, words
):
    values = {"min_free_bytes": 5, "output": "here"}

    def set_values(request):
        values.update(taken)
        return answer(result=SetParametersResult(successful=successful, reason=reason))

    stand.answers["logger/get_parameters"] = lambda request: answer(
        values=[Parameter(name, value=values[name]).to_parameter_msg().value for name in request.names]
    )
    stand.answers["logger/set_parameters_atomically"] = set_values
    monkeypatch.setattr(soak_run, "_REFUSED", soak_run._REFUSED[-1:])
    failures = stand.failures_of(soak_run.refused_parameters, soak)
    assert (words is None) == (failures == [])
    assert words is None or words in failures[0]


def test_an_amplifier_that_does_not_go_off_or_not_on_is_a_failure(soak, stand):
    stand.answers["driver/enable"] = answer()
    act = soak_run.amplifier_off_and_on
    assert stand.failures_of(act, soak) == ["the amplifier is 'on' after it was switched off"]
    assert len(soak.enable_s) == 1

    def switched(request):
        stand.condition = "off"
        return answer(success=request.data is False, message="no fresh command")

    stand.answers["driver/enable"] = switched
    (failure,) = stand.failures_of(act, soak)
    assert "allowed: on within 2 s (no fresh command)" in failure
    assert len(soak.enable_s) == 1


def test_a_driver_that_the_controller_does_not_miss_is_a_failure(soak, stand):
    for tripped, failures in ((None, 1), (Fault.MAP_MISSING, 1), (Fault.SAMPLE_TIMEOUT, 0)):
        stand.tripped = tripped and Seen(tripped, NOW)
        soak.killable = ["driver"]
        assert len(stand.failures_of(soak_run.ACTIONS["SIGKILL"], soak)) == failures


def test_a_recorder_that_refuses_is_a_failure_unless_an_answer_was_lost_and_none_at_all_ends_the_action(soak, stand):
    stand.answers["logger/split"] = answer(success=False, message="nothing is being recorded")
    split = soak_run.ACTIONS["split"]
    assert stand.failures_of(split, soak) == ["logger/split was refused: nothing is being recorded"]

    def lost(request):
        stand.answers_lost += 1
        return answer(success=False)

    stand.answers["logger/split"] = lost
    assert stand.failures_of(split, soak) == []
    del stand.answers["logger/split"]
    with pytest.raises(LaunchError, match="does not answer"):
        split(soak)


def test_a_node_that_does_not_change_its_state_is_a_failure(soak, stand):
    stand.heartbeats.states = dict.fromkeys(stand.names, "active")
    stand.answers["driver/enable"] = answer()
    failures = stand.failures_of(soak_run.down_and_up, soak)
    assert len(failures) == 4 and failures[0] == "logger is active; it must be inactive"


def growth(*looks, every_s=60):
    return grown("driver", 7, [Look(k * every_s * SECOND, *numbers) for k, numbers in enumerate(looks)])[1]


def test_one_descriptor_or_thread_more_at_the_end_is_a_failure_and_a_peak_before_is_none():
    assert growth((22, 13, 200.0), (30, 15, 201.0), (22, 13, 202.0)) == []
    assert "23 descriptors after 22" in growth((22, 13, 200.0), (23, 13, 200.0))[0]
    assert "14 threads after 13" in growth((22, 13, 200.0), (22, 14, 200.0))[0]


def test_memory_that_grows_too_fast_for_long_enough_is_a_failure_once_it_is_more_than_histories():
    step = 1.1 * MEMORY_LIMIT_MB_PER_HOUR / 60.0
    looks = [(22, 13, 200.0 + step * minute) for minute in range(12 + round(HISTORIES_MB / step))]
    assert growth(*looks[:12]) == []
    assert "grows by 66 MB/h; allowed: 60" in growth(*looks)[0]
    assert growth(*looks, every_s=5) == []
    assert growth(*[(22, 13, 200.0 + 0.8 * step * minute) for minute in range(120)]) == []


def test_a_run_has_passed_only_if_something_was_done_and_nothing_failed(soak, stand):
    assert not soak.figures([])["passed"]
    soak.counts["actions"]["split"] += 1
    assert soak.figures([])["passed"] and not soak.figures(["a bag has a gap"])["passed"]
    soak.looks["driver", 7] = [Look(0, 22, 13, 200.0), Look(SECOND, 23, 13, 200.0)]
    assert not soak.figures([])["passed"] and len(soak.figures([])["failures"]) == 1
    soak.looks.clear()
    stand.fail("the amplifier is 'off'")
    assert soak.figures([])["failures"] == ["the amplifier is 'off'"]


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
    file = tmp_path / "stalls"
    file.write_text("0 1000000000 20.0\n0 5000000000 7.5\n0 6000")
    assert stalls.total_ms(file, 970_000_000, 979_000_000) == pytest.approx(0.0)
    assert stalls.total_ms(file, 970_000_000, 981_000_000) == pytest.approx(20.0)
    assert stalls.total_ms(file, 1_000_000_001, 9_000_000_000) == pytest.approx(7.5)
    assert stalls.total_ms(file, 0, 9_000_000_000) == pytest.approx(27.5)
    file.write_text("0 1000000000 20.0\n1 1000000000 30.0\n")
    assert stalls.total_ms(file, 0, 2_000_000_000) == pytest.approx(30.0)


def test_a_watch_that_is_stopped_for_a_while_has_seen_a_stall(tmp_path):
    file = tmp_path / "stalls"
    with stalls.watched(file, 0) as process:
        time.sleep(2.0)
        begin = time.time_ns()
        os.kill(process.pid, signal.SIGSTOP)
        time.sleep(0.3)
        os.kill(process.pid, signal.SIGCONT)
        end = time.monotonic() + 30.0
        while stalls.total_ms(file, begin, time.time_ns()) < 200.0 and time.monotonic() < end:
            time.sleep(0.05)
        assert stalls.total_ms(file, begin, time.time_ns()) >= 200.0
    assert process.returncode is not None
