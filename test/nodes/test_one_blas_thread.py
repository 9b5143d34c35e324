"""A node's linear algebra has one thread: OpenBLAS's own wait in busy loops, for ever with real-time priority."""

import os
import subprocess
import sys

CODE = """
import straightcomp_ros.nodes.controller_node
import numpy, os
a = numpy.ones((300, 300)); a @ a
print(len(os.listdir("/proc/self/task")), os.environ["OPENBLAS_NUM_THREADS"])
"""


def test_a_node_computes_in_one_thread():
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    told = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, timeout=120)
    assert told.stdout.split() == ["1", "1"], told.stderr


def test_a_user_may_choose_otherwise():
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    told = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, timeout=120)
    assert told.stdout.split()[1] == "2", told.stderr
