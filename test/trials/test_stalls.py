"""The watch that tells whether this machine stood still."""

import os
import signal
import time

import pytest

from trials.stalls import Stalls


def test_a_stall_is_found_in_the_time_that_it_took_and_in_no_other(tmp_path):
    watch = Stalls(tmp_path, 0)
    for file in watch.files.values():
        file.write_text("")
    next(iter(watch.files.values())).write_text("1000000000 20.0\n5000000000 7.5\n6000")
    assert watch.total_ms(970_000_000, 979_000_000) == pytest.approx(0.0)
    assert watch.total_ms(970_000_000, 981_000_000) == pytest.approx(20.0)
    assert watch.total_ms(1_000_000_001, 9_000_000_000) == pytest.approx(7.5)
    assert watch.total_ms(0, 9_000_000_000) == pytest.approx(27.5)


def test_stalls_of_two_cpus_are_not_added_up(tmp_path):
    watch = Stalls(tmp_path, 0)
    watch.files = {0: tmp_path / "a", 1: tmp_path / "b"}
    (tmp_path / "a").write_text("1000000000 20.0\n")
    (tmp_path / "b").write_text("1000000000 30.0\n")
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
