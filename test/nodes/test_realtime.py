"""What the real-time parameters set, and what is said where the system does not permit it."""

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

REPORT = """
import json, os, threading, time
from straightcomp_ros.timing import realtime
{start}
threading.Thread(target=time.sleep, args=(30,), daemon=True).start()
refusals = realtime.apply(realtime.RealtimeParameters({arguments}))
helpers = {{t.native_id for t in threading.enumerate()}} - {{threading.get_native_id()}}
threads = []
for thread in map(int, os.listdir("/proc/self/task")):
    name = "helper" if thread in helpers else open(f"/proc/self/task/{{thread}}/comm").read().strip()
    threads.append((name, os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority))
locked = open("/proc/self/status").read().partition("VmLck:")[2].split()[0]
print(json.dumps(dict(refusals=refusals, threads=threads, cpus=sorted(os.sched_getaffinity(0)), locked=int(locked))))
"""


def report(arguments, start=""):
    """What a process with these parameters has: refusals, (name, policy, priority) of each thread, CPUs, kB locked."""
    code = REPORT.format(arguments=arguments, start=start)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    return SimpleNamespace(**json.loads(done.stdout))


def test_all_threads_but_the_node_s_own_helpers_get_the_priority_if_asked_for_or_the_refusal_is_said():
    assert {tuple(rest) for _, *rest in report("").threads} == {(os.SCHED_OTHER, 0)}
    found = report("priority=7")
    if found.refusals:
        assert "priority 7 was refused" in found.refusals[0] and "rtprio in limits.conf" in found.refusals[0]
    else:
        scheduled = {(name == "helper", *rest) for name, *rest in found.threads}
        assert scheduled == {(False, os.SCHED_FIFO, 7), (True, os.SCHED_OTHER, 0)}


@pytest.mark.nightly
def test_fast_dds_s_polling_thread_cannot_keep_a_cpu_from_the_threads_that_it_waits_for():
    found = report("priority=7", "import rclpy\nrclpy.init()\nnode = rclpy.create_node('node')")
    if found.refusals:
        pytest.skip(found.refusals[0])
    own = {name: tuple(rest) for name, *rest in found.threads if name.startswith("dds.")}
    polling = {name for name in own if name.startswith("dds.asyn")}
    assert polling and {own.pop(name) for name in polling} == {(os.SCHED_RR, 6)}
    assert set(own.values()) == {(os.SCHED_FIFO, 7)}


def test_loop_and_rest_share_out_the_cpus_or_the_process_stays_on_those_named():
    *others, last = sorted(os.sched_getaffinity(0))
    assert report("cpus='loop'").cpus == report(f"cpus='{last}'").cpus == [last]
    found = report("priority=7, cpus='rest'")
    assert found.cpus == (others or [last])
    # Its priority is below that of the loops.
    assert found.refusals or [os.SCHED_FIFO, 6] in [rest for _, *rest in found.threads]


def test_memory_is_locked_or_the_refusal_is_said():
    found = report("lock_memory=True")
    assert found.locked > 0 or "memlock in limits.conf" in found.refusals[0]
