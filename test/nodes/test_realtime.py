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


def test_a_node_has_the_priority_cpu_and_memory_that_it_asks_for_or_says_what_the_system_refuses():
    found = report("priority=7, cpus='loop', lock_memory=True")
    refused = "\n".join(found.refusals)
    assert len(found.cpus) == 1
    assert found.locked > 0 or "memlock in limits.conf" in refused
    if "priority 7 was refused" in refused:
        assert "rtprio in limits.conf" in refused
    else:
        scheduled = {(name == "helper", *rest) for name, *rest in found.threads}
        assert scheduled == {(False, os.SCHED_FIFO, 7), (True, os.SCHED_OTHER, 0)}


@pytest.mark.nightly
def test_beside_the_loops_a_node_has_a_lower_priority_and_fast_dds_s_polling_thread_one_below_that():
    *others, last = sorted(os.sched_getaffinity(0))
    found = report("priority=7, cpus='rest'", "import rclpy\nrclpy.init()\nnode = rclpy.create_node('node')")
    assert found.cpus == (others or [last])
    if found.refusals:
        pytest.skip(found.refusals[0])
    own = {name: tuple(rest) for name, *rest in found.threads if name.startswith("dds.")}
    polling = {name for name in own if name.startswith("dds.asyn")}
    assert polling and {own.pop(name) for name in polling} == {(os.SCHED_RR, 5)}
    assert set(own.values()) == {(os.SCHED_FIFO, 6)}
