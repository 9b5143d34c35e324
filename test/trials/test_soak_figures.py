"""Figures of a soak run: each check fails when it must."""

import os
import subprocess
import sys

import pytest

from straightcomp_ros.cell.launcher import ros_available
from straightcomp_ros.cli.main import main
from trials.soak_verdict import (
    MEMORY_LIMIT_MB_PER_HOUR,
    Actions,
    Life,
    Lives,
    Look,
    Soak,
    exits,
    look,
)

SECOND = 10**9
needs_ros = pytest.mark.skipif(not ros_available(), reason="rclpy is not there")


def life(*looks, every_s=60):
    return Life("driver", 7, [Look(k * every_s * SECOND, *numbers) for k, numbers in enumerate(looks)])


def passed(**changed):
    values = {"actions": {"split": Actions(done=2)}, "lives": [life((22, 13, 200.0), (22, 13, 200.0))], **changed}
    return Soak(1, **values).passed


def test_a_process_that_keeps_descriptors_and_threads_has_not_failed():
    assert life((22, 13, 200.0), (30, 15, 201.0), (22, 13, 202.0)).failures() == []


def test_one_descriptor_or_thread_more_at_the_end_is_a_failure_in_words():
    assert "23 open descriptors after 22" in life((22, 13, 200.0), (23, 13, 200.0)).failures()[0]
    assert "14 threads after 13" in life((22, 13, 200.0), (22, 14, 200.0)).failures()[0]


def test_memory_that_grows_faster_than_allowed_is_a_failure_where_it_was_seen_for_long_enough():
    step = 1.1 * MEMORY_LIMIT_MB_PER_HOUR / 60.0
    grown = [(22, 13, 200.0 + step * minute) for minute in range(12)]
    assert "grows by 66 MB/h; allowed: 60" in life(*grown).failures()[0]
    assert life(*grown, every_s=10).failures() == []
    assert life(*[(22, 13, 200.0 + 0.8 * step * minute) for minute in range(12)]).failures() == []


def test_a_run_has_passed_only_if_something_was_done_and_nothing_failed():
    assert passed()
    assert not passed(actions={})
    failed = Actions()
    failed.add(["the amplifier is 'off'"])
    assert not passed(actions={"split": failed})
    assert not passed(lives=[life((22, 13, 200.0), (23, 13, 200.0))])
    assert not passed(failures=["logger did not stop"])


def test_every_failure_is_told_in_words_with_its_action():
    actions = Actions()
    actions.add([])
    actions.add(["one", "another"])
    assert (actions.done, actions.failed) == (2, 1)
    run = Soak(1, actions={"split": actions}, failures=["driver did not stop"])
    assert run.to_display()["failures"] == ["split: one", "split: another", "driver did not stop"]
    assert run.to_display()["actions"] == {"split": {"done": 2, "failed": 1}}


def test_a_node_that_does_not_end_or_not_with_0_is_told():
    assert exits({"driver": 0, "logger": 0}) == []
    assert exits({"driver": None, "logger": -9}) == ["driver did not stop", "logger stopped with exit code -9"]


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


@needs_ros
@pytest.mark.parametrize("minutes", ["0", "-1", "nan"])
def test_a_time_that_is_none_is_refused(minutes, capsys):
    assert main(["soak", f"--minutes={minutes}"]) == 2
    assert "--minutes" in capsys.readouterr().err


@needs_ros
def test_a_folder_that_is_not_empty_is_refused(tmp_path, capsys):
    (tmp_path / "bag_1").mkdir()
    assert main(["soak", "-o", str(tmp_path)]) == 2
    assert "not empty" in capsys.readouterr().err
