"""Which CPUs loops take, and how other programs are kept off them; all other processes are the test's own."""

import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from waiting import comes_true

from straightcomp_ros.timing import cpu_guard, cpus
from straightcomp_ros.timing.cpus import (
    at_normal_priority,
    claim,
    claimed,
    end_loop,
    keep_others_off,
    loop_cpu,
    loop_cpus,
)

CPUS = {0, 1, 2, 3}
GUARD = """
import sys
sys.path.insert(0, {root!r})
from pathlib import Path
from straightcomp_ros.timing import cpu_guard
cpu_guard._PROCESSES, cpu_guard._WORK_QUEUES = Path({processes!r}), Path({queues!r})
cpu_guard.NOTES = Path({notes!r})
sys.exit(cpu_guard.main(sys.argv[1:]))
"""
NODE = """
import sys
from straightcomp_ros.timing import cpu_guard, cpus
cpus._KEPT, cpus._LOOPS, cpu_guard.__file__ = sys.argv[1:4]
print(cpus.keep_others_off({int(sys.argv[4])}), flush=True)
sys.stdin.read()
"""


@pytest.fixture
def own_names(monkeypatch):
    """Names of claims that no other process uses."""
    for name in ("_LOOPS", "_KEPT", "_CHOICE"):
        monkeypatch.setattr(cpus, name, f"test{name}/{os.getpid()}/")
    monkeypatch.setattr(cpus, "_held", [])
    monkeypatch.setattr(cpus, "_ended", set())
    monkeypatch.setattr(cpus, "_TURN_S", 0.1)
    yield
    while cpus._held:
        end_one()


def end_one():
    """The system closes the claims of a node that ends in whatever way, and the input of its guard."""
    held = cpus._held.pop()
    if isinstance(held, subprocess.Popen):
        held.stdin.close()
        try:
            # A guard that does not end fails the test.
            held.wait(60)
        finally:
            held.kill()
    with held:
        pass


def other(cpu, graph, process=1):
    """A process of another graph with its loop on this CPU."""
    return claim(f"{cpus._LOOPS}{cpu}/{graph}/{process}")


class Stand:
    """Bystanders, and the last CPU, which the guard of this process, a node, keeps them off."""

    def __init__(self, folder):
        self.all = os.sched_getaffinity(0)
        self.cpu = max(self.all)
        self.rest = self.all - {self.cpu}
        self.processes, self.queues, self.notes = folder / "proc", folder / "mask", folder / "notes"
        self.processes.mkdir()
        self.notes.mkdir()
        self.queues.write_text("ff\n")
        self.started = []

    def bystander(self, cpus=None):
        """A process that others can see; returns its id."""
        process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        self.started.append(process)
        if cpus:
            os.sched_setaffinity(process.pid, cpus)
        (self.processes / str(process.pid)).symlink_to(f"/proc/{process.pid}")
        return process.pid


@pytest.fixture
def stand(tmp_path, monkeypatch, own_names):
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("one CPU has nothing to share out")
    made, guard = Stand(tmp_path), tmp_path / "guard.py"
    paths = {name: str(getattr(made, name)) for name in ("processes", "queues", "notes")}
    guard.write_text(GUARD.format(root=str(Path(cpus.__file__).parents[2]), **paths))
    monkeypatch.setattr(cpu_guard, "__file__", str(guard))
    monkeypatch.setattr(cpu_guard, "NOTES", made.notes)
    yield made
    for process in made.started:
        process.kill()
        process.wait()


def test_others_leave_the_cpu_until_the_node_ends(stand, monkeypatch):
    free, elsewhere, bound = stand.bystander(), stand.bystander(stand.rest), stand.bystander({stand.cpu})
    assert keep_others_off({stand.cpu}) == f"kept 1 threads of other programs off CPU {stand.cpu}"
    assert os.sched_getaffinity(free) == os.sched_getaffinity(elsewhere) == stand.rest
    # It could run nowhere.
    assert os.sched_getaffinity(bound) == {stand.cpu}
    assert int(stand.queues.read_text(), 16) == 0xFF & ~(1 << stand.cpu)
    child = stand.bystander(stand.rest)
    cpus._held[0].stdin.close()
    # A node that is started again takes over from the one that has ended.
    monkeypatch.setattr(cpus, "_TURN_S", 60.0)
    assert keep_others_off({stand.cpu}).startswith("kept 2 threads") and os.sched_getaffinity(free) == stand.rest
    end_one()
    assert os.sched_getaffinity(free) == os.sched_getaffinity(child) == stand.all
    assert os.sched_getaffinity(elsewhere) == stand.rest
    assert stand.queues.read_text().strip() == "ff"


def test_others_are_given_the_cpu_back_when_the_node_is_killed(stand):
    free, words = stand.bystander(), [cpus._KEPT, cpus._LOOPS, cpu_guard.__file__, str(stand.cpu)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    node = subprocess.Popen([sys.executable, "-c", NODE, *words], **pipes)
    stand.started.append(node)
    with node.stdin, node.stdout:
        assert node.stdout.readline().startswith(b"kept") and os.sched_getaffinity(free) == stand.rest
        node.kill()
        assert comes_true(lambda: os.sched_getaffinity(free) == stand.all and not list(stand.notes.iterdir()))
    assert stand.queues.read_text().strip() == "ff"


def test_what_a_killed_guard_left_behind_is_seen_and_corrected_by_the_next_node(stand):
    free, elsewhere = stand.bystander(), stand.bystander(stand.rest)
    assert cpus.kept_free() == set()
    keep_others_off({stand.cpu})
    # Nodes that start meanwhile may use the CPU all the same.
    assert cpus.kept_free() == {stand.cpu} and cpus.left_behind() == set()
    guard = cpus._held.pop()
    assert os.getsid(guard.pid) == guard.pid  # Ctrl-C in the node's terminal does not reach it
    guard.kill()
    guard.communicate()
    assert cpus.left_behind() == {stand.cpu} and cpus.kept_free() == set()
    assert os.sched_getaffinity(free) == stand.rest and stand.queues.read_text().strip() != "ff"

    assert keep_others_off({stand.cpu}).startswith("kept 0 threads") and cpus.left_behind() == set()
    end_one()
    assert os.sched_getaffinity(free) == stand.all and os.sched_getaffinity(elsewhere) == stand.rest
    assert stand.queues.read_text().strip() == "ff" and not list(stand.notes.iterdir())
    assert cpus.left_behind() == set()


def test_a_note_of_another_boot_or_of_another_make_says_nothing(stand, monkeypatch):
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
    with pytest.raises(OSError, match="there is no other CPU"):
        keep_others_off(stand.all)
    others = [other(cpu, "graph") for cpu in stand.rest]
    with pytest.raises(OSError, match="each other CPU has the loop of another graph"):
        keep_others_off({stand.cpu})
    for one in others:
        one.close()
    keep_others_off({stand.cpu})
    with pytest.raises(OSError, match="another node keeps them free for itself"):
        keep_others_off({stand.cpu})


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
