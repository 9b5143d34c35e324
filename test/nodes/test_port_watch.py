"""A node whose port in shared memory was removed under it hears again."""

import ctypes
import errno
import json
import mmap
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

from straightcomp_ros.nodes.port_watch import Port, PortWatch

NUMBER = 65000  # no port of any domain
NAME = f"fastrtps_port{NUMBER}"
SHARED_MEMORY = Path("/dev/shm")
LISTENER = """
import os, re, sys, rclpy, json
from std_msgs.msg import String
from straightcomp_ros.nodes.middleware import own_profile
from straightcomp_ros.nodes.port_watch import PERIOD_S, PortWatch
from straightcomp_ros.shared_memory import held_by
with own_profile():
    rclpy.init()
    node = rclpy.create_node("listener")
heard = set()
def hear(message):
    if message.data not in heard:
        heard.add(message.data)
        print(json.dumps(message.data), flush=True)
node.create_subscription(String, "name", hear, 10)
ports = [int(m[1]) for m in map(re.compile(r"fastrtps_port(\\d+)_el").fullmatch, held_by(os.getpid())) if m]
print(json.dumps(ports), flush=True)
watch = PortWatch(lambda text: print(text, file=sys.stderr, flush=True))
node.create_timer(PERIOD_S, watch.look)
rclpy.spin(node)
"""
TALKER = """
import sys, rclpy
from std_msgs.msg import String
from straightcomp_ros.nodes.middleware import own_profile
with own_profile():
    rclpy.init()
    node = rclpy.create_node("talker_" + sys.argv[1])
publisher = node.create_publisher(String, "name", 10)
node.create_timer(0.05, lambda: publisher.publish(String(data=sys.argv[1])))
rclpy.spin(node)
"""


def mapped(path):
    path.write_bytes(bytes(4096))
    with path.open("r+b") as file:
        return mmap.mmap(file.fileno(), 0)


@pytest.fixture
def in_memory():
    """A folder where a newer file has a larger inode: on a disk it may get that of a removed one."""
    with tempfile.TemporaryDirectory(dir=SHARED_MEMORY) as folder:
        yield Path(folder)


@pytest.mark.skipif(not SHARED_MEMORY.is_dir(), reason="Fast DDS's shared memory lies elsewhere here")
def test_a_port_is_lost_when_its_file_stays_away_and_found_when_another_is_mapped(in_memory):
    old = mapped(in_memory / NAME)
    port = Port(NAME, NUMBER, in_memory)
    assert [port.is_lost() for _ in range(3)] == [False] * 3
    (in_memory / NAME).unlink()
    assert [port.is_lost() for _ in range(3)] == [False, True, True], "Fast DDS has time to make it anew"
    (in_memory / NAME).write_bytes(bytes(4096))
    assert port.is_lost(), "another's file of the same name"
    new = mapped(in_memory / NAME)
    assert not port.is_lost()
    old.close()
    new.close()


def test_a_port_that_was_never_mapped_is_not_lost(tmp_path):
    port = Port(NAME, NUMBER, tmp_path)
    assert not any(port.is_lost() for _ in range(3))


def test_the_reader_is_woken_from_its_wait_and_nobody_else():
    library = ctypes.CDLL(None, use_errno=True)
    semaphores = {name: ctypes.create_string_buffer(64) for name in (f"dds.shm.{NUMBER}", "dds.shm.65001")}
    answers = {}

    def wait(name):
        library.prctl(15, name.encode())  # PR_SET_NAME
        answer = library.sem_wait(semaphores[name])
        answers[name] = (answer, ctypes.get_errno())

    threads = [threading.Thread(target=wait, args=(name,)) for name in semaphores]
    PortWatch(lambda text: None)
    for name in semaphores:
        library.sem_init(semaphores[name], 0, 0)
    for thread in threads:
        thread.start()
    end = time.monotonic() + 30.0
    while not answers and time.monotonic() < end:
        Port(NAME, NUMBER).wake_reader()
        time.sleep(0.05)
    assert answers == {f"dds.shm.{NUMBER}": (-1, errno.EINTR)}
    library.sem_post(semaphores["dds.shm.65001"])
    for thread in threads:
        thread.join()
    assert answers["dds.shm.65001"][0] == 0


def test_without_a_reader_nobody_is_woken():
    assert not Port(NAME, NUMBER).wake_reader()


@pytest.mark.live
@pytest.mark.keeps_time
@pytest.mark.skipif(not SHARED_MEMORY.is_dir(), reason="Fast DDS's shared memory lies elsewhere here")
def test_who_starts_after_the_port_was_removed_is_heard_too():
    processes = []

    def start(*words, **options):
        processes.append(subprocess.Popen([sys.executable, "-c", *words], text=True, **options))
        return processes[-1]

    try:
        listener = start(LISTENER, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        end_of_patience = threading.Timer(90.0, listener.kill)
        end_of_patience.start()
        ports = json.loads(listener.stdout.readline())
        assert ports, "Fast DDS does not use shared memory here"
        start(TALKER, "first")
        assert json.loads(listener.stdout.readline()) == "first"
        for port in ports:
            os.unlink(SHARED_MEMORY / f"fastrtps_port{port}")
        start(TALKER, "second")
        assert json.loads(listener.stdout.readline()) == "second"
        listener.kill()
        assert f"port {max(ports)} in shared memory was removed" in listener.stderr.read()
    finally:
        end_of_patience.cancel()
        for process in processes:
            process.kill()
            process.wait()
