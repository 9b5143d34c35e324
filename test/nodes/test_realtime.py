"""What the real-time parameters set, and what is said where the system does not permit it."""

import os
import subprocess
import sys

import pytest

from straightcomp_ros.timing import realtime
from straightcomp_ros.timing.realtime import RealtimeParameters

REPORT = """
import os, sys, threading, time
from straightcomp_ros.timing.realtime import RealtimeParameters
from straightcomp_ros.timing import realtime
threading.Thread(target=time.sleep, args=(30,), daemon=True).start()
for refusal in realtime.apply(RealtimeParameters({arguments})):
    print("refused", refusal)
helpers = {{t.native_id for t in threading.enumerate()}} - {{threading.get_native_id()}}
for thread in map(int, os.listdir("/proc/self/task")):
    print(thread in helpers, os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority)
print(sorted(os.sched_getaffinity(0)), open("/proc/self/status").read().partition("VmLck:")[2].split()[0])
"""


def printed(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    return done.stdout.splitlines()


def report(arguments):
    return printed(REPORT.format(arguments=arguments))


def test_all_threads_but_the_node_s_own_helpers_get_the_priority_if_asked_for_or_the_refusal_is_said():
    assert {line.split(" ", 1)[1] for line in report("")[:-1]} == {f"{os.SCHED_OTHER} 0"}
    *threads, _ = report("priority=7")
    if threads[0].startswith("refused"):
        assert "priority 7 was refused" in threads[0] and "rtprio in limits.conf" in threads[0]
    else:
        assert f"False {os.SCHED_FIFO} 7" in threads
        assert f"True {os.SCHED_OTHER} 0" in threads


MIDDLEWARE = """
import os, rclpy
from rclpy.node import Node
from straightcomp_ros.timing import realtime
rclpy.init()
node = Node("node")
for refusal in realtime.apply(realtime.RealtimeParameters(priority=7)):
    print("refused", refusal)
for thread in os.listdir("/proc/self/task"):
    name = open(f"/proc/self/task/{thread}/comm").read().strip()
    print(name, os.sched_getscheduler(int(thread)), os.sched_getparam(int(thread)).sched_priority)
"""


@pytest.mark.nightly
def test_fast_dds_s_polling_thread_cannot_keep_a_cpu_from_the_threads_that_it_waits_for():
    found = {name: rest for name, _, rest in (line.partition(" ") for line in printed(MIDDLEWARE))}
    if "refused" in found:
        pytest.skip(found["refused"])
    polling = {name for name in found if name.startswith("dds.asyn")}
    assert polling and {found.pop(name) for name in polling} == {f"{os.SCHED_RR} 6"}
    assert {rest for name, rest in found.items() if name.startswith("dds.")} == {f"{os.SCHED_FIFO} 7"}


def test_loop_and_rest_share_out_the_cpus_or_the_process_stays_on_those_named():
    *others, last = sorted(os.sched_getaffinity(0))
    assert report("cpus='loop'")[-1].startswith(f"[{last}]")
    assert report(f"cpus='{last}'")[-1].startswith(f"[{last}]")
    threads = report("priority=7, cpus='rest'")
    assert threads[-1].startswith(str(others or [last]))
    # Its priority is below that of the loops.
    assert threads[0].startswith("refused") or f"False {os.SCHED_FIFO} 6" in threads


def test_cpus_that_cannot_be_had_are_refused_and_memory_is_locked_or_the_refusal_is_said():
    before = os.sched_getaffinity(0)
    for cpus in ("4095", "none", "0,", "-1"):
        (refusal,) = realtime.apply(RealtimeParameters(cpus=cpus))
        assert f"CPUs '{cpus}'" in refusal and "Remedy" in refusal
    assert os.sched_getaffinity(0) == before
    lines = report("lock_memory=True")
    assert int(lines[-1].rsplit(" ", 1)[1]) > 0 or "memlock in limits.conf" in lines[0]


def test_the_request_to_keep_awake_is_held_open_or_its_refusal_said(monkeypatch, tmp_path):
    file = tmp_path / "cpu_dma_latency"
    monkeypatch.setattr(realtime, "_CPU_LATENCY", str(file))
    assert realtime.apply(RealtimeParameters(keep_awake=True)) == []
    assert file.read_bytes() == bytes(4) and not realtime._held[-1].closed
    realtime._held.pop().close()
    monkeypatch.setattr(realtime, "_CPU_LATENCY", str(tmp_path / "none" / "file"))
    (refusal,) = realtime.apply(RealtimeParameters(keep_awake=True))
    assert "udev" in refusal
