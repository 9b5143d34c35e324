"""How long a process waited for a CPU, and what is said of it."""

import os
import subprocess
import sys

import pytest

from straightcomp_ros.timing.delays import CpuWait
from straightcomp_ros.timing.node_timing import CPU_WAIT, NORMAL, REFUSED, SCHEDULING, HeldUp, blamed, held_up


class Scheduler:
    """A folder as /proc/PID/task, with what the scheduler counts for each thread."""

    def __init__(self, folder):
        self.folder = folder
        self.waited_ns = {}

    def wait(self, thread, ns):
        self.waited_ns[thread] = self.waited_ns.get(thread, 0) + ns
        (self.folder / thread).mkdir(exist_ok=True)
        # The scheduler writes no new file: who has it open reads the new numbers.
        file = self.folder / thread / "schedstat"
        with open(file, "r+" if file.exists() else "w") as output:
            output.write(f"123456789 {self.waited_ns[thread]} 42\n")


@pytest.fixture
def scheduler(tmp_path):
    scheduler = Scheduler(tmp_path)
    scheduler.wait("11", 5_000_000_000)
    scheduler.wait("12", 1_000_000_000)
    return scheduler


@pytest.fixture
def cpu_wait(scheduler):
    cpu_wait = CpuWait(scheduler.folder)
    assert cpu_wait.take_us() == 0.0
    yield cpu_wait
    for file in cpu_wait._files.values():
        file.close()


def test_the_longest_wait_of_any_thread_from_look_to_look_counts(scheduler, cpu_wait):
    scheduler.wait("11", 3_000_000)
    cpu_wait.look()
    scheduler.wait("12", 180_000_000)
    cpu_wait.look()
    scheduler.wait("11", 7_000_000)
    assert cpu_wait.take_us() == pytest.approx(180_000.0)
    assert cpu_wait.take_us() == 0.0


def test_what_a_thread_waited_before_it_was_first_seen_does_not_count(scheduler, cpu_wait):
    scheduler.wait("13", 900_000_000)
    assert cpu_wait.take_us() == 0.0
    scheduler.wait("13", 2_000_000)
    assert cpu_wait.take_us() == pytest.approx(2_000.0)


def test_a_thread_that_has_ended_is_forgotten(scheduler, cpu_wait):
    (scheduler.folder / "11" / "schedstat").write_text("")
    scheduler.wait("12", 4_000_000)
    assert cpu_wait.take_us() == pytest.approx(4_000.0)


def test_a_system_without_these_counts_has_no_waits(tmp_path):
    cpu_wait = CpuWait(tmp_path / "absent")
    cpu_wait.look()
    assert cpu_wait.take_us() == 0.0


def test_linux_counts_a_process_that_others_keep_from_its_cpu():
    """Two threads that both want one CPU wait for each other."""
    cpu = min(os.sched_getaffinity(0))
    code = (
        "import hashlib, os, sys, threading\n"
        "from straightcomp_ros.timing.delays import CpuWait\n"
        f"os.sched_setaffinity(0, {{{cpu}}})\n"
        "data = bytes(1 << 20)\n"
        "waited = CpuWait()\n"
        # A digest of much data is made without the interpreter's lock.
        "threads = [threading.Thread(target=lambda: [hashlib.sha256(data) for _ in range(200)]) for _ in range(2)]\n"
        "[thread.start() for thread in threads]\n"
        "waited.take_us()\n"
        "[thread.join(0.05) or waited.look() for thread in threads]\n"
        "print(waited.take_us())\n"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert float(printed.stdout) > 0.0


@pytest.mark.parametrize(
    ("scheduling", "remedy"),
    [
        (REFUSED, "real-time priority is not permitted; remedy: straightcomp doctor"),
        (NORMAL, "real-time priority was not requested; remedy: the parameter realtime.priority"),
    ],
)
def test_who_got_no_cpu_is_named_with_the_remedy(scheduling, remedy):
    words = blamed({"driver": HeldUp(1e3, 2e3, scheduling), "controller": HeldUp(180e3, 200e3, scheduling)})
    assert words == f"the controller got no CPU for 180 ms; {remedy}"


def test_other_programs_are_not_blamed_for_what_holds_up_a_node_of_real_time_priority():
    words = blamed({"driver": HeldUp(200e3, 300e3, "FIFO 40"), "controller": HeldUp(100.0, 20e3, "FIFO 40")})
    assert "the driver was late by 300 ms, and no other program had its CPU" in words
    assert "controller" not in words


def test_nobody_is_blamed_for_short_waits_or_unknown_ones():
    assert blamed({"driver": HeldUp(3e3, 4e3, NORMAL), "controller": HeldUp()}) == ""


def report(wait_us, late_us, scheduling=NORMAL):
    return {CPU_WAIT: str(wait_us), "timer_error_max_us": str(late_us), SCHEDULING: scheduling}


def test_a_node_got_no_cpu_for_as_long_as_both_its_lateness_and_the_scheduler_say():
    reports = [report(7000, 8000.0), report(40_000, 900.0), report(9000, 60_000.0, "FIFO 40"), {}]
    assert held_up(reports) == HeldUp(7000.0, 60_000.0, "FIFO 40")
    assert held_up([report(7000, "nan")]) == held_up([report("nan", "nan")]) == HeldUp(0.0, 0.0, NORMAL)
    assert held_up([{}]) == held_up([]) == HeldUp()
