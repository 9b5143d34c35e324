"""A node's linear algebra has one thread: OpenBLAS's own wait in busy loops, for ever with real-time priority."""

import os
import subprocess
import sys

import pytest

CODE = "import sys, os, straightcomp_ros.nodes; print(os.environ['OPENBLAS_NUM_THREADS'], 'numpy' in sys.modules)"


@pytest.mark.parametrize(("chosen", "threads"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_a_node_computes_in_one_thread_unless_its_user_chooses_more(chosen: dict[str, str], threads: str) -> None:
    others = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    told = subprocess.run(
        [sys.executable, "-c", CODE], env={**others, **chosen}, capture_output=True, text=True, timeout=120, check=True
    )
    # NumPy reads it once, when it is imported.
    assert told.stdout.split() == [threads, "False"]
