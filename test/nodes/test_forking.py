"""What a process that forks nodes asks of the libraries in it."""

import subprocess
import sys

import pytest

COUNT = """
import os, sys
from straightcomp_ros.trials.faults import forking
forking.without_blas_threads()
import numpy, rclpy, scipy.linalg

def threads():
    return len(os.listdir("/proc/self/task"))

forking.tell_tracing()
for _ in range(3):
    child = os.fork()
    if child == 0:
        os._exit(threads())
    _, status = os.waitpid(child, 0)
    print(threads(), os.waitstatus_to_exitcode(status), forking._tracing_library() is not None)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")
def test_a_forked_process_has_the_threads_of_its_parent_since_tracing_is_told():
    printed = subprocess.run([sys.executable, "-c", COUNT], capture_output=True, text=True, check=True).stdout
    counts = [line.split() for line in printed.splitlines()]
    assert len(counts) == 3
    for parent, child, traced in counts:
        if traced == "False":
            pytest.skip("this ROS 2 is built without LTTng")
        assert child == parent
        assert int(child) > 1
