"""Figures of a soak run: each check fails when it must."""

import os
import subprocess
import sys

import pytest

from straightcomp_ros.cell.launcher import ros_available
from trials.__main__ import run
from trials.soak_verdict import MEMORY_LIMIT_MB_PER_HOUR, Life, Lives, Look, Soak, look

SECOND = 10**9


def life(*looks, every_s=60):
    return Life("driver", 7, [Look(k * every_s * SECOND, *numbers) for k, numbers in enumerate(looks)])


def test_a_process_that_keeps_descriptors_and_threads_has_not_failed():
    assert life((22, 13, 200.0), (30, 15, 201.0), (22, 13, 202.0)).failures() == []


def test_one_descriptor_or_thread_more_at_the_end_is_a_failure():
    assert "23 descriptors after 22" in life((22, 13, 200.0), (23, 13, 200.0)).failures()[0]
    assert "14 threads after 13" in life((22, 13, 200.0), (22, 14, 200.0)).failures()[0]


def test_memory_that_grows_faster_than_allowed_is_a_failure_where_it_was_seen_for_long_enough():
    step = 1.1 * MEMORY_LIMIT_MB_PER_HOUR / 60.0
    grown = [(22, 13, 200.0 + step * minute) for minute in range(12)]
    assert "grows by 66 MB/h; allowed: 60" in life(*grown).failures()[0]
    assert life(*grown, every_s=10).failures() == []
    assert life(*[(22, 13, 200.0 + 0.8 * step * minute) for minute in range(12)]).failures() == []


def test_a_run_has_passed_only_if_something_was_done_and_nothing_failed():
    def figures(action_failures=(), **changed):
        soak = Soak(1, **{"lives": [life((22, 13, 200.0), (22, 13, 200.0))], **changed})
        soak.add("split", action_failures)
        return soak.to_display()

    assert not Soak(1).to_display()["passed"]
    assert figures()["passed"] and figures()["actions"] == {"split": 1}
    assert figures(["the amplifier is 'off'"])["failures"] == ["split: the amplifier is 'off'"]
    for failed in (
        figures(["the amplifier is 'off'"]),
        figures(lives=[life((22, 13, 200.0), (23, 13, 200.0))]),
        figures(failures=["logger did not stop"]),
    ):
        assert not failed["passed"] and len(failed["failures"]) == 1


def test_a_look_sees_descriptors_that_are_opened_and_threads_that_are_started():
    code = "import threading\nprint(flush=True)\ninput()\nkept = [open('/dev/null') for _ in range(5)]\n"
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


def test_a_process_counts_from_its_second_look_on():
    lives = Lives()
    lives.see({"driver": os.getpid()})
    assert os.getpid() in lives and lives.finished([]) == []
    lives.see({"driver": os.getpid()})
    assert [(life.name, life.survived) for life in lives.finished([os.getpid()])] == [("driver", True)]
    assert not lives.finished([])[0].survived


@pytest.mark.skipif(not ros_available(), reason="rclpy is not there")
@pytest.mark.parametrize("minutes", ["0", "-1", "nan"])
def test_a_duration_that_is_none_is_refused(minutes, capsys):
    assert run(["soak", f"--minutes={minutes}"]) == 2
    assert "--minutes" in capsys.readouterr().err
