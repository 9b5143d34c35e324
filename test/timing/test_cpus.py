"""Which CPUs loops take, and how other programs are kept off them; all other processes are the test's own."""

import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from unittest.mock import Mock

import pytest
from waiting import comes_true

from straightcomp_ros.timing import cpu_guard, cpus
from straightcomp_ros.timing.cpus import at_normal_priority, claim, claimed, end_loop, loop_cpu, loop_cpus

CPUS = {0, 1, 2, 3}
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
        self.processes, self.queues, self.notes = folder / "proc", folder / "mask", folder / "notes"
        self.processes.mkdir()
        self.notes.mkdir()
        self.queues.write_text("ff\n")
        paths = {"processes": self.processes, "queues": self.queues, "notes": self.notes}
        self.server, root = folder / "server.py", str(Path(cpus.__file__).parents[2])
        self.server.write_text(SERVER.format(root=root, **{name: str(path) for name, path in paths.items()}))
        self._started = []

    def bystander(self, cpus=None):
        """A process that others can see; returns its id."""
        process = self._start("import time; time.sleep(60)")
        if cpus:
            os.sched_setaffinity(process.pid, cpus)
        (self.processes / str(process.pid)).symlink_to(f"/proc/{process.pid}")
        return process.pid

    def node(self, cpus=None):
        """A node that keeps others off; returns it with what it said."""
        names = {"name": self.name, "loops": self.loops, "server": str(self.server)}
        node = self._start(NODE.format(**names, cpus=cpus or {self.cpu}))
        return node, node.stdout.readline().strip() or node.stderr.read().strip().splitlines()[-1]

    def _start(self, code):
        pipe = subprocess.PIPE
        self._started.append(subprocess.Popen([sys.executable, "-c", code], text=True, stdout=pipe, stderr=pipe))
        return self._started[-1]

    def back(self, pid, cpus):
        return comes_true(lambda: os.sched_getaffinity(pid) == cpus)


@pytest.fixture
def stand(tmp_path):
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("one CPU has nothing to share out")
    made = Stand(tmp_path)
    yield made
    for process in made._started:
        process.kill()
        process.communicate()


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
    # A node that is started again takes over from the one that has ended.
    node, said = stand.node()
    assert said.startswith("kept 2 threads") and os.sched_getaffinity(free) == rest
    node.send_signal(number)
    assert stand.back(free, stand.all) and stand.back(child, stand.all)
    assert os.sched_getaffinity(elsewhere) == rest
    assert stand.queues.read_text().strip() == "ff"


def test_what_a_killed_guard_left_behind_is_seen_and_corrected_by_the_next_node(stand, monkeypatch):
    monkeypatch.setattr(cpus, "_KEPT", stand.name)
    monkeypatch.setattr(cpu_guard, "NOTES", stand.notes)
    rest = stand.all - {stand.cpu}
    free, elsewhere = stand.bystander(), stand.bystander(rest)
    assert cpus.kept_free() == set()
    node, _ = stand.node()
    # Nodes that start meanwhile may use the CPU all the same.
    assert cpus.kept_free() == {stand.cpu} and cpus.left_behind() == set()
    (process,) = Path(f"/proc/{node.pid}/task/{node.pid}/children").read_text().split()
    assert os.getsid(int(process)) == int(process)  # Ctrl-C in the node's terminal does not reach it
    os.kill(int(process), signal.SIGKILL)
    node.kill()
    assert comes_true(lambda: cpus.left_behind() == {stand.cpu}) and cpus.kept_free() == set()
    assert os.sched_getaffinity(free) == rest and stand.queues.read_text().strip() != "ff"

    node, said = stand.node()
    assert said.startswith("kept 0 threads") and cpus.left_behind() == set()
    node.kill()
    assert stand.back(free, stand.all)
    assert comes_true(lambda: stand.queues.read_text().strip() == "ff" and not list(stand.notes.iterdir()))
    assert os.sched_getaffinity(elsewhere) == rest and cpus.left_behind() == set()


def test_a_note_of_another_boot_or_of_another_make_says_nothing(stand, monkeypatch):
    monkeypatch.setattr(cpu_guard, "NOTES", stand.notes)
    note = stand.notes / cpu_guard.note_name(os.getuid(), stand.cpu)
    cpu_guard.write_note(note, [4, 2], "ff")
    assert cpu_guard.read_note(note) == ({2, 4}, "ff") and cpus.left_behind() == {stand.cpu}
    assert note.stat().st_mode & 0o777 == 0o600
    for text in ("", "[]", '["a", "b"]', "7"):
        note.write_text(text)
        assert cpu_guard.read_note(note) is None
    note.rename(note.with_name(note.name.replace(f"_{stand.cpu}.", "_9999.")))
    (stand.notes / cpu_guard.note_name(os.getuid(), "x")).touch()
    assert cpus.left_behind() == set()
    cpu_guard.write_note(note, [], "ff")
    monkeypatch.setattr(cpu_guard, "_BOOT", stand.queues)  # another text
    assert cpus.left_behind() == set()


def test_a_cpu_of_another_node_all_cpus_and_the_last_without_a_loop_are_refused(stand):
    assert "there is no other CPU" in stand.node(stand.all)[1]
    others = [claim(f"{stand.loops}{cpu}/graph/1") for cpu in stand.all - {stand.cpu}]
    assert "each other CPU has the loop of another graph" in stand.node()[1]
    for one in others:
        one.close()
    assert stand.node()[1].startswith("kept")
    assert "another node keeps them free for itself" in stand.node()[1]


def test_what_belongs_to_other_users_stays_and_is_counted(stand, monkeypatch):
    stand.bystander()
    monkeypatch.setattr(cpu_guard, "_PROCESSES", stand.processes)
    monkeypatch.setattr(os, "sched_setaffinity", Mock(side_effect=PermissionError))
    assert cpu_guard._move(lambda affinity: affinity - {stand.cpu}) == (0, 1)


def test_a_guard_moves_who_may_go_elsewhere_until_no_new_one_inherits_the_cpu_and_looks_at_normal_priorities_only(
    tmp_path, monkeypatch
):
    may = {1: {0, 1}, 2: {1}, 3: {0}, 4: {0, 1}, 5: {0, 1}, 6: {0, 1, 2}, 7: {0, 1}, 8: {1, 2}, 9: {0, 1}}
    policies = dict.fromkeys((1, 2, 3, 5, 8, 9), os.SCHED_OTHER) | {4: os.SCHED_BATCH}
    policies |= {6: os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 7: 6}
    asked, begins = [], {9}

    def there(thread):
        # One is the kernel's own, and one begins after the guard has looked for the first time.
        if thread in begins:
            begins.remove(thread)
            raise ProcessLookupError
        return thread

    def move(thread, wanted):
        asked.append(thread)
        if thread in (4, 8):
            raise PermissionError if thread == 4 else OSError
        may[thread] = wanted

    for thread in may:
        (tmp_path / "77" / "task" / str(thread)).mkdir(parents=True)
    monkeypatch.setattr(cpu_guard, "_PROCESSES", tmp_path)
    monkeypatch.setattr(os, "sched_getscheduler", lambda thread: policies[there(thread)])
    monkeypatch.setattr(os, "sched_getaffinity", lambda thread: may[thread])
    monkeypatch.setattr(os, "sched_setaffinity", move)
    assert cpu_guard._move(lambda affinity: affinity - {1}, without={5}) == (2, 1)
    assert may == {1: {0}, 2: {1}, 3: {0}, 4: {0, 1}, 5: {0, 1}, 6: {0, 1, 2}, 7: {0, 1}, 8: {1, 2}, 9: {0}}
    assert sorted(thread for thread in asked if thread != 8) == [1, 4, 9]


def test_a_guard_changes_the_bits_of_its_own_cpus_in_a_mask_and_guards_give_back_theirs_in_any_order(
    tmp_path, monkeypatch
):
    mask = tmp_path / "mask"
    monkeypatch.setattr(cpu_guard, "_WORK_QUEUES", mask)
    few = (({3},), "7"), (({2},), "3"), (({3}, "f"), "b"), (({2}, "7"), "f")
    # bitmap_parse of Linux takes 32 bits between two commas.
    many = (
        (({63, 70},), "bf,7fffffff,ffffffff"),
        (({63, 70}, "ff,ffffffff,ffffffff"), "ff,ffffffff,ffffffff"),
        ((set(range(32, 72)),), "ffffffff"),
        (({32}, "1,00000000"), "1,ffffffff"),
        ((set(range(32)),), "1,00000000"),
    )
    for before, steps in (("f\n", few), ("ff,ffffffff,ffffffff\n", many)):
        mask.write_text(before)
        for cpus_and_before, then in steps:
            cpu_guard._set_queues(*cpus_and_before)
            assert mask.read_text() == then


@pytest.fixture
def own_names(monkeypatch):
    """Names of claims that no other process uses."""
    monkeypatch.setattr(cpus, "_LOOPS", f"test_loops/{os.getpid()}/")
    monkeypatch.setattr(cpus, "_CHOICE", f"test_choice/{os.getpid()}")
    monkeypatch.setattr(cpus, "_held", [])
    monkeypatch.setattr(cpus, "_ended", set())
    monkeypatch.setattr(cpus, "_TURN_S", 0.1)
    yield
    for held in cpus._held:
        held.close()


def other(cpu, graph, process=1):
    """A process of another graph with its loop on this CPU."""
    return claim(f"{cpus._LOOPS}{cpu}/{graph}/{process}")


def test_graphs_take_different_cpus_from_the_last_one_down_and_keep_them_as_long_as_one_of_their_processes_lives(
    own_names,
):
    with claim(cpus._CHOICE), pytest.raises(OSError, match="choosing"):
        loop_cpu("0/a", CPUS)
    assert loop_cpu("0/a", CPUS) == 3
    # That process asks again, and another one of the graph comes while other graphs have begun.
    mark = claimed(cpus._LOOPS)[0].split("/")[1]
    assert other(3, mark, process=2) is not None
    assert [loop_cpu(graph, CPUS) for graph in ("0/b", "1/a", "0/a")] == [2, 1, 3]
    cpus._held.pop(0).close()
    assert loop_cpu("0/a", CPUS) == 3
    assert loop_cpus() == {1, 2, 3}


def test_where_each_cpu_has_a_loop_a_graph_takes_the_permitted_one_with_the_fewest(own_names):
    loops = [other(0, "a"), other(0, "b"), other(1, "c"), other(1, "c", 2), other(1, "d"), other(2, "e"), other(3, "f")]
    assert loop_cpu("g", CPUS) == 3
    loops[-1].close()
    assert loop_cpu("h", CPUS) in (2, 3)
    assert loop_cpu("i", {0}) == 0


@pytest.mark.parametrize(
    "forged",
    [b"x/y/z", b"1", b"", b"-1/a/1", b"9999999/a/1", b"1/a/b/2", b"1/a/", b"\xff\xfe", b"\xd9\xa1/a/1", b"1/\x1b[2J/1"],
)
def test_a_name_of_another_form_which_any_user_may_claim_is_passed_over(own_names, monkeypatch, forged):
    monkeypatch.setattr(cpus, "_KEPT", cpus._LOOPS)
    before = socket.socket(socket.AF_UNIX)
    before.bind(b"\0a\nb @" + cpus._LOOPS.encode() + forged)
    with before, socket.socket(socket.AF_UNIX) as after:
        after.bind(b"\0" + cpus._LOOPS.encode() + forged)
        assert loop_cpus() == set() and cpus.kept_free() == ({1} if forged == b"1" else set())
        assert loop_cpu("a", CPUS) == 3


def test_work_that_takes_long_leaves_the_cpus_of_loops_and_comes_back(own_names):
    permitted = os.sched_getaffinity(0)
    if len(permitted) < 2:
        pytest.skip("one CPU has nothing to share out")
    loop_cpu("a", permitted)
    with pytest.raises(ValueError), at_normal_priority():
        assert os.sched_getaffinity(0) == permitted - loop_cpus()
        assert os.sched_getscheduler(0) == os.SCHED_OTHER
        raise ValueError
    assert os.sched_getaffinity(0) == permitted
    # The recorder of the same graph still has its claim.
    assert other(max(loop_cpus()), claimed(cpus._LOOPS)[0].split("/")[1], process=2) is not None
    end_loop()
    with at_normal_priority():
        assert os.sched_getaffinity(0) == permitted


def test_work_that_takes_long_gives_up_its_own_threads_priority_and_gets_it_back(own_names, monkeypatch):
    asked = []
    monkeypatch.setattr(os, "sched_getscheduler", lambda thread: os.SCHED_FIFO)
    monkeypatch.setattr(os, "sched_getparam", lambda thread: os.sched_param(40))
    monkeypatch.setattr(os, "sched_setscheduler", lambda *given: asked.append((*given[:2], given[2].sched_priority)))
    with at_normal_priority():
        assert asked == [(0, os.SCHED_OTHER, 0)]
    assert asked[1:] == [(0, os.SCHED_FIFO, 40)]


def test_a_name_is_waited_for_as_long_as_is_asked(own_names):
    held = other(0, "a")
    assert other(0, "a") is None
    release = threading.Timer(0.05, held.close)
    release.start()
    with claim(f"{cpus._LOOPS}0/a/1", 30.0):
        release.join()


@pytest.mark.parametrize(
    ("own", "loops", "used", "then"),
    [
        ({0}, {1}, True, {0, 1}),
        ({0, 1}, {1}, False, {0}),
        ({0}, {0, 1}, True, {0}),  # another loop may be at work on its CPU
        ({1}, {1}, False, {1}),  # a thread that has no other CPU keeps it
    ],
)
def test_a_client_may_compute_on_the_cpu_of_a_loop_at_rest(monkeypatch, own, loops, used, then):
    monkeypatch.setattr(cpus, "kept_free", lambda: {1})
    monkeypatch.setattr(cpus, "loop_cpus", lambda: loops)
    taken = [own]
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: own)
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, wanted: taken.append(wanted))
    cpus.use_kept_free(used)
    assert taken[-1] == then
