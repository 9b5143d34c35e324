"""Other programs leave a node's CPU for as long as it lives; here these are processes of the test's own only."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import comes_true

from straightcomp_ros.timing import cpu_guard, cpus, realtime
from straightcomp_ros.timing.cpus import claim
from straightcomp_ros.timing.realtime import RealtimeParameters

pytestmark = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one CPU has nothing to share out")

SERVER = """
import sys
sys.path.insert(0, {root!r})
from pathlib import Path
from straightcomp_ros.timing import cpu_guard
cpu_guard._PROCESSES, cpu_guard._WORK_QUEUES = Path({processes!r}), Path({queues!r})
cpu_guard.NOTES = Path({notes!r})
sys.exit(cpu_guard.main(sys.argv[1:]))
"""
NODE = """
import sys, time
from straightcomp_ros.timing import cpu_guard, cpus
cpus._KEPT, cpus._TURN_S, cpus._LOOPS = {name!r}, 0.2, {loops!r}
cpu_guard.__file__ = {server!r}
print(cpus.keep_others_off({cpus!r}), flush=True)
time.sleep(60)
"""


class Stand:
    """Bystanders, and nodes that want the last CPU without them."""

    def __init__(self, folder):
        self.all = os.sched_getaffinity(0)
        self.cpu = max(self.all)
        self.name, self.loops = f"test/{os.getpid()}/", f"test_loops/{os.getpid()}/"
        self.processes, self.queues, self.server = folder / "proc", folder / "mask", folder / "server.py"
        self.notes = folder / "notes"
        self.processes.mkdir()
        self.notes.mkdir()
        self.queues.write_text("ff\n")
        root = str(Path(cpus.__file__).parents[2])
        self.server.write_text(
            SERVER.format(
                root=root,
                processes=str(self.processes),
                queues=str(self.queues),
                notes=str(self.notes),
            )
        )
        self._started = []

    def bystander(self, cpus=None):
        """A process that others can see; returns its id."""
        process = self._start("import time; time.sleep(60)")
        if cpus:
            os.sched_setaffinity(process.pid, cpus)
        self.show(process.pid)
        return process.pid

    def show(self, pid):
        (self.processes / str(pid)).symlink_to(f"/proc/{pid}")

    def node(self, cpus=None):
        """A node that keeps others off; returns it with what it said."""
        names = {"name": self.name, "loops": self.loops, "server": str(self.server)}
        node = self._start(NODE.format(**names, cpus=cpus or {self.cpu}))
        return node, node.stdout.readline().strip() or node.stderr.read().strip().splitlines()[-1]

    def _start(self, code):
        process = subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self._started.append(process)
        return process

    def back(self, pid, cpus):
        return comes_true(lambda: os.sched_getaffinity(pid) == cpus)

    def close(self):
        for process in self._started:
            process.kill()
            process.communicate()


@pytest.fixture
def stand(tmp_path):
    made = Stand(tmp_path)
    yield made
    made.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_others_leave_the_cpu_until_the_node_ends_in_whatever_way(stand, number):
    rest = stand.all - {stand.cpu}
    free, elsewhere, bound = stand.bystander(), stand.bystander(rest), stand.bystander({stand.cpu})
    node, said = stand.node()
    assert said == f"kept 1 threads of other programs off CPU {stand.cpu}"
    assert os.sched_getaffinity(free) == os.sched_getaffinity(elsewhere) == rest
    # It could run nowhere.
    assert os.sched_getaffinity(bound) == {stand.cpu}
    assert int(stand.queues.read_text(), 16) == 0xFF & ~(1 << stand.cpu)
    child = stand.bystander(rest)
    node.send_signal(number)
    assert stand.back(free, stand.all) and stand.back(child, stand.all)
    assert os.sched_getaffinity(elsewhere) == rest
    assert stand.queues.read_text().strip() == "ff"


def test_what_a_killed_guard_left_behind_is_seen_and_mended_by_the_next_node(stand, monkeypatch):
    monkeypatch.setattr(cpus, "_KEPT", stand.name)
    monkeypatch.setattr(cpu_guard, "NOTES", stand.notes)
    rest = stand.all - {stand.cpu}
    free, elsewhere = stand.bystander(), stand.bystander(rest)
    node, _ = stand.node()
    assert cpus.left_behind() == set()  # it lives
    (process,) = Path(f"/proc/{node.pid}/task/{node.pid}/children").read_text().split()
    os.kill(int(process), signal.SIGKILL)
    node.kill()
    assert comes_true(lambda: cpus.left_behind() == {stand.cpu})
    assert os.sched_getaffinity(free) == rest and stand.queues.read_text().strip() != "ff"

    node, said = stand.node()
    assert said.startswith("kept 0 threads")
    assert cpus.left_behind() == set()
    node.kill()
    assert stand.back(free, stand.all)
    assert comes_true(lambda: stand.queues.read_text().strip() == "ff")
    assert os.sched_getaffinity(elsewhere) == rest
    assert comes_true(lambda: not list(stand.notes.iterdir()))
    assert cpus.left_behind() == set()


def test_a_note_of_another_boot_or_of_another_make_says_nothing(stand, monkeypatch):
    monkeypatch.setattr(cpu_guard, "NOTES", stand.notes)
    note = cpu_guard.Note({stand.cpu})
    note.write([4, 2], "ff")
    assert note.read() == ({2, 4}, "ff") and cpus.left_behind() == {stand.cpu}
    file = next(stand.notes.iterdir())
    assert file.stat().st_mode & 0o777 == 0o600
    for text in ("", "[]", '["a", "b"]', "7"):
        file.write_text(text)
        assert note.read() is None
    file.rename(file.with_name(file.name.replace(f"_{stand.cpu}.", "_9999.")))
    (stand.notes / cpu_guard.note_name(os.getuid(), "x")).touch()
    assert cpus.left_behind() == set()
    note.write([], "ff")
    boot = stand.notes / "boot"
    boot.write_text("another\n")
    monkeypatch.setattr(cpu_guard, "_BOOT", boot)
    assert cpus.left_behind() == set()


def test_the_nodes_that_start_meanwhile_may_use_the_cpu_all_the_same(stand, monkeypatch):
    monkeypatch.setattr(cpus, "_KEPT", stand.name)
    assert cpus.kept_free() == set()
    node, _ = stand.node()
    assert cpus.kept_free() == {stand.cpu}
    node.kill()
    assert comes_true(lambda: cpus.kept_free() == set())


def test_a_second_node_is_refused_the_same_cpu_and_all_cpus_are_too_many(stand):
    assert "there is no other CPU" in stand.node(stand.all)[1]
    stand.node()
    assert "another node keeps them free for itself" in stand.node()[1]


def test_other_programs_keep_a_cpu_that_no_loop_has(stand):
    others = [claim(f"{stand.loops}{cpu}/graph/1") for cpu in stand.all - {stand.cpu}]
    assert "each other CPU has the loop of another graph" in stand.node()[1]
    for one in others:
        one.close()
    assert stand.node()[1].startswith("kept")


def test_the_node_that_is_started_again_takes_over_from_the_killed_one(stand):
    bystander = stand.bystander()
    for _ in range(3):
        node, said = stand.node()
        assert said.startswith("kept 1 threads")
        assert os.sched_getaffinity(bystander) == stand.all - {stand.cpu}
        node.kill()
    assert stand.back(bystander, stand.all)


def test_what_belongs_to_other_users_stays_and_is_counted(stand, monkeypatch):
    bystander = stand.bystander()
    monkeypatch.setattr(cpu_guard, "_PROCESSES", stand.processes)

    def refuse(*_):
        raise PermissionError

    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    assert cpu_guard._move(lambda affinity: affinity - {stand.cpu}) == (0, 1)
    assert os.sched_getaffinity(bystander) == stand.all


def test_guards_of_several_graphs_give_back_their_own_cpus_in_any_order(tmp_path, monkeypatch):
    mask = tmp_path / "mask"
    monkeypatch.setattr(cpu_guard, "_WORK_QUEUES", mask)
    mask.write_text("f\n")
    before = {}
    for cpu in (3, 2):
        before[cpu] = cpu_guard._queues()
        cpu_guard._keep_queues_off({cpu})
    assert mask.read_text() == "3"
    cpu_guard._give_queues_back({3}, before[3])
    assert mask.read_text() == "b"
    cpu_guard._give_queues_back({2}, before[2])
    assert mask.read_text() == "f"


def test_a_node_says_what_it_did_or_why_not(monkeypatch):
    told = []
    monkeypatch.setattr(realtime, "keep_others_off", lambda cpus: f"kept off {sorted(cpus)}")
    assert realtime.apply(RealtimeParameters(exclusive=True), told.append) == []
    assert told == [f"kept off {sorted(os.sched_getaffinity(0))}"]
    monkeypatch.undo()
    # Without CPUs of its own it has all of them.
    (refusal,) = realtime.apply(RealtimeParameters(exclusive=True), told.append)
    assert "there is no other CPU" in refusal and "realtime.cpus" in refusal
