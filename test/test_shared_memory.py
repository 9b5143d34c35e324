"""Files of Fast DDS in shared memory: those of a living owner stay, those of a dead one go."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from straightcomp_ros.shared_memory import held_by, remove_stale

SEGMENT = ("fastrtps_0123456789abcdef", "fastrtps_0123456789abcdef_el")
PORT = ("fastrtps_port7411", "fastrtps_port7411_el", "sem.fastrtps_port7411_mutex")
SHARED_PORT = ("fastrtps_port7400", "fastrtps_port7400_sl", "sem.fastrtps_port7400_mutex")
HOLD = """
import fcntl, sys, time
files = [open(path, "rb") for path in sys.argv[2:]]
for file in files:
    fcntl.flock(file, fcntl.LOCK_EX if sys.argv[1] == "exclusive" else fcntl.LOCK_SH)
print("held", flush=True)
time.sleep(60)
"""


def make(folder, *names):
    for name in names:
        (folder / name).write_bytes(b"")


def names(folder):
    return set(os.listdir(folder))


@pytest.fixture
def owner():
    """Starts a process that holds lock files, as a participant does."""
    processes = []

    def start(kind, *paths):
        process = subprocess.Popen([sys.executable, "-c", HOLD, kind, *map(str, paths)], stdout=subprocess.PIPE)
        processes.append(process)
        assert process.stdout.readline() == b"held\n"
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait()
        process.stdout.close()


def test_files_of_a_living_owner_stay_until_it_is_killed(tmp_path, owner):
    make(tmp_path, *SEGMENT, *PORT, *SHARED_PORT)
    exclusive = owner("exclusive", tmp_path / SEGMENT[1], tmp_path / PORT[1])
    shared = [owner("shared", tmp_path / SHARED_PORT[1]) for _ in range(2)]
    assert remove_stale(tmp_path, young=0.0) == []
    exclusive.send_signal(signal.SIGKILL)
    shared[0].send_signal(signal.SIGKILL)
    exclusive.wait()
    shared[0].wait()
    assert sorted(remove_stale(tmp_path, young=0.0)) == sorted((*SEGMENT, *PORT))
    assert names(tmp_path) == set(SHARED_PORT)
    shared[1].kill()
    shared[1].wait()
    assert set(remove_stale(tmp_path, young=0.0)) == set(SHARED_PORT)
    assert names(tmp_path) == set()


def test_a_port_stays_whose_owner_holds_its_other_lock_file(tmp_path, owner):
    # A process that is killed while it looks whether the port is shared leaves the file for that.
    make(tmp_path, *PORT, "fastrtps_port7411_sl")
    process = owner("exclusive", tmp_path / PORT[1])
    assert remove_stale(tmp_path, young=0.0) == []
    process.kill()
    process.wait()
    assert remove_stale(tmp_path, young=0.0)
    assert set(PORT).isdisjoint(names(tmp_path))


def test_files_that_were_just_made_stay(tmp_path):
    make(tmp_path, *PORT)
    assert remove_stale(tmp_path) == [] and names(tmp_path) == set(PORT)


def test_nothing_else_is_touched(tmp_path):
    others = (
        "fastrtps_port7411",  # no lock: a writer may have it open
        "sem.fastrtps_port7412_mutex",
        "fastrtps_0123456789abcdeg_el",
        "fastrtps_0123_el",
        "xfastrtps_port7411_el",
        "fastrtps_port7411_el.bak",
        "fast_datasharing_1_el",
        "lttng-ust-wait-6",
    )
    make(tmp_path, *others)
    os.symlink(tmp_path / "lttng-ust-wait-6", tmp_path / "fastrtps_port7413_el")
    assert remove_stale(tmp_path, young=0.0) == []
    assert names(tmp_path) == {*others, "fastrtps_port7413_el"}


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_files_of_another_user_stay(tmp_path):
    make(tmp_path, *PORT, *SEGMENT)
    for name in (PORT[1], SEGMENT[0]):
        os.chown(tmp_path / name, 12345, 12345)
    assert remove_stale(tmp_path, young=0.0) == [SEGMENT[1]]
    assert names(tmp_path) == {*PORT, SEGMENT[0]}


def test_many_that_clean_at_once_remove_each_file_once(tmp_path):
    ports = [name.replace("7411", str(7411 + k)) for k in range(100) for name in PORT]
    make(tmp_path, *ports)
    removed = []
    threads = [threading.Thread(target=lambda: removed.extend(remove_stale(tmp_path, young=0.0))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(removed) == sorted(ports)


def test_a_machine_without_the_folder_has_nothing_to_clean(tmp_path):
    assert remove_stale(tmp_path / "absent") == []


def test_a_process_holds_the_lock_files_that_it_has_open(tmp_path):
    make(tmp_path, *SEGMENT, *PORT)
    with (tmp_path / SEGMENT[1]).open(), (tmp_path / PORT[0]).open():
        assert held_by(os.getpid()) == {SEGMENT[1]}
    assert held_by(os.getpid()) == set()
