"""Which CPU a graph's loop takes beside other graphs; the other processes here are claims of the test's own."""

import os

import pytest

from straightcomp_ros.timing import cpus
from straightcomp_ros.timing.cpus import at_normal_priority, claim, claimed

CPUS = {0, 1, 2, 3}


@pytest.fixture(autouse=True)
def own_names(monkeypatch):
    monkeypatch.setattr(cpus, "_LOOPS", f"test_loops/{os.getpid()}/")
    monkeypatch.setattr(cpus, "_CHOICE", f"test_choice/{os.getpid()}")
    monkeypatch.setattr(cpus, "_held", [])
    monkeypatch.setattr(cpus, "_TURN_S", 0.1)
    yield
    for held in cpus._held:
        held.close()


def other(cpu, graph, process=1):
    """A process of another graph with its loop on this CPU."""
    return claim(f"{cpus._LOOPS}{cpu}/{graph}/{process}")


def test_graphs_take_different_cpus_from_the_last_one_down():
    assert [cpus.loop_cpu(graph, CPUS) for graph in ("0/a", "0/b", "1/a")] == [3, 2, 1]
    assert cpus.loop_cpus() == {1, 2, 3}


def test_all_processes_of_a_graph_have_the_same_cpu_for_as_long_as_one_of_them_lives():
    first = cpus.loop_cpu("a", CPUS)
    # That process asks again, and another one of the graph comes while a second graph has begun.
    mark = claimed(cpus._LOOPS)[0].split("/")[1]
    assert other(first, mark, process=2) is not None
    assert cpus.loop_cpu("b", CPUS) == 2
    assert cpus.loop_cpu("a", CPUS) == first
    cpus._held.pop(0).close()
    assert cpus.loop_cpu("a", CPUS) == first


def test_where_each_cpu_has_a_loop_a_graph_takes_the_one_with_the_fewest():
    loops = [other(0, "a"), other(0, "b"), other(1, "c"), other(1, "c", 2), other(1, "d"), other(2, "e"), other(3, "f")]
    assert cpus.loop_cpu("g", CPUS) == 3
    loops[-1].close()
    assert cpus.loop_cpu("h", CPUS) in (2, 3)


def test_a_cpu_that_this_process_may_not_use_is_not_taken():
    assert cpus.loop_cpu("a", {0, 1}) == 1
    assert cpus.loop_cpu("a", {0}) == 0


def test_a_process_that_chooses_for_ever_is_not_waited_for():
    with claim(cpus._CHOICE), pytest.raises(OSError, match="choosing"):
        cpus.loop_cpu("a", CPUS)
    assert cpus.loop_cpu("a", CPUS) == 3


def test_work_that_takes_long_leaves_the_cpus_of_loops_and_comes_back():
    cpus = os.sched_getaffinity(0)
    if len(cpus) < 2:
        pytest.skip("one CPU has nothing to share out")
    cpus.loop_cpu("a", cpus)
    with pytest.raises(ValueError), at_normal_priority():
        assert os.sched_getaffinity(0) == cpus - cpus.loop_cpus()
        assert os.sched_getscheduler(0) == os.SCHED_OTHER
        raise ValueError
    assert os.sched_getaffinity(0) == cpus
