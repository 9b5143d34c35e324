"""A node that was killed starts again, and whoever else talks on this machine does not notice."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from waiting import wait_for_line

from straightcomp_ros.shared_memory import remove_stale

pytestmark = pytest.mark.keeps_time

SHARED_MEMORY = Path("/dev/shm")
TALKER = """
import rclpy
from std_msgs.msg import Int64
rclpy.init()
node = rclpy.create_node("talker")
publisher = node.create_publisher(Int64, "count", 10)
count = 0
def publish():
    global count
    count += 1
    publisher.publish(Int64(data=count))
node.create_timer(0.02, publish)
rclpy.spin(node)
"""
LISTENER = """
import rclpy
from std_msgs.msg import Int64
rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(Int64, "count", lambda message: print(message.data, flush=True), 10)
rclpy.spin(node)
"""


def fast_dds_files_of(process):
    """Names of the lock files that a process has open."""
    links = [os.readlink(entry) for entry in Path(f"/proc/{process.pid}/fd").iterdir() if entry.is_symlink()]
    return {Path(link).name for link in links if link.startswith("/dev/shm/fastrtps_")}


@pytest.fixture
def pair(tmp_path):
    """Talker and listener in processes of their own; gives the counts that have been heard so far."""
    heard = (tmp_path / "heard").open("w+")
    processes = [
        subprocess.Popen([sys.executable, "-c", TALKER]),
        subprocess.Popen([sys.executable, "-c", LISTENER], stdout=heard),
    ]

    def counts():
        return [int(line) for line in (tmp_path / "heard").read_text().split("\n")[:-1]]

    end = time.monotonic() + 120
    while len(counts()) < 10 and time.monotonic() < end:
        time.sleep(0.1)
    yield counts
    for process in processes:
        process.kill()
        process.wait()
    heard.close()


@pytest.mark.skipif(not SHARED_MEMORY.is_dir(), reason="Fast DDS's shared memory lies elsewhere here")
def test_a_killed_node_starts_again_cleanly_while_another_pair_talks_on(graph, pair):
    assert len(pair()) >= 10
    killed = graph.start("driver", {})
    wait_for_line(graph, "driver", "ready")
    left = fast_dds_files_of(killed)
    assert left, "Fast DDS does not use shared memory here"
    time.sleep(2.5)  # younger files are left alone
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert left <= set(os.listdir(SHARED_MEMORY))
    before = len(pair())

    again = graph.start("driver", {})
    wait_for_line(graph, "driver", "ready")
    present = set(os.listdir(SHARED_MEMORY))
    # A port has the same name again when the new node listens there.
    assert not (left - fast_dds_files_of(again)) & present
    assert "SHM" not in graph.log("driver").read_text()
    again.send_signal(signal.SIGINT)
    assert again.wait(timeout=120) == 0

    # Nothing of the living pair is taken away, and not one of its (reliable) messages is lost.
    remove_stale()
    time.sleep(1.0)
    counts = pair()
    assert len(counts) > before
    assert counts == list(range(counts[0], counts[0] + len(counts)))
