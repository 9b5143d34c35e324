"""A client may compute on the CPU of a loop that is at rest, unless there are other loops."""

import os

import pytest

from straightcomp_ros.timing import cpus


@pytest.fixture
def own(monkeypatch):
    """CPUs that the thread has; the system's calls are replaced."""
    have = {0}
    monkeypatch.setattr(cpus, "kept_free", lambda: {1})
    monkeypatch.setattr(cpus, "loop_cpus", lambda: {1})
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(have))

    def take(pid, wanted):
        have.clear()
        have.update(wanted)

    monkeypatch.setattr(os, "sched_setaffinity", take)
    return have


def test_the_cpu_of_a_loop_at_rest_is_used_and_left_again(own):
    cpus.use_kept_free(True)
    assert own == {0, 1}
    cpus.use_kept_free(False)
    assert own == {0}


def test_beside_another_loop_its_cpu_is_left_alone(own, monkeypatch):
    monkeypatch.setattr(cpus, "loop_cpus", lambda: {0, 1})
    cpus.use_kept_free(True)
    assert own == {0}


def test_a_thread_that_has_no_other_cpu_keeps_it(own):
    own.clear()
    own.add(1)
    cpus.use_kept_free(False)
    assert own == {1}
