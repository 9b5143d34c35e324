"""CPUs and priorities of a process's threads, on a machine that permits or refuses them."""

import errno
import os
import threading
from unittest.mock import Mock

import pytest

from straightcomp_ros.timing import realtime
from straightcomp_ros.timing.realtime import LOOP, REST, RealtimeParameters, place


class Machine:
    """CPUs, policy and priority by thread, as the kernel keeps them. Of its four CPUs a killed guard took the first
    from the process; the last two have loops, and this process's is the last."""

    def __init__(self, folder, monkeypatch, permits):
        self.me, self.permits, self.done = threading.get_native_id(), permits, []
        self.threads = {thread: [{1, 2, 3}, os.SCHED_OTHER, 0] for thread in (self.me, 10**8, 10**8 + 1)}
        for thread, name in zip(self.threads, ("python", "dds.asyn.1", "dds.udp"), strict=True):
            (folder / str(thread)).mkdir()
            (folder / str(thread) / "comm").write_text(name)
        (folder / str(10**8 + 2)).mkdir()  # has ended meanwhile
        monkeypatch.setattr(realtime, "_THREADS", str(folder))
        for name in ("getaffinity", "setaffinity", "getscheduler", "setscheduler"):
            monkeypatch.setattr(os, f"sched_{name}", getattr(self, name))
        monkeypatch.setattr(realtime, "loop_cpu", lambda graph, permitted: max(permitted))
        monkeypatch.setattr(realtime, "loop_cpus", lambda: {2, 3})
        monkeypatch.setattr(realtime, "kept_free", lambda: set())
        monkeypatch.setattr(realtime, "left_behind", lambda: {0})
        for name in ("_lock_memory", "_keep_awake"):
            monkeypatch.setattr(realtime, name, lambda name=name: self.done.append(name))
        monkeypatch.setattr(realtime, "keep_others_off", lambda cpus: f"off {sorted(cpus)}")

    def thread(self, number):
        if (number or self.me) not in self.threads:
            raise ProcessLookupError
        return self.threads[number or self.me]

    def getaffinity(self, number):
        return self.thread(number)[0]

    def setaffinity(self, number, cpus):
        self.thread(number)[0] = set(cpus)

    def getscheduler(self, number):
        return self.thread(number)[1]

    def setscheduler(self, number, policy, parameter):
        if not (self.permits and parameter.sched_priority > 0):
            raise PermissionError
        self.thread(number)[1:] = policy, parameter.sched_priority


FIFO, ROUND, OTHER = os.SCHED_FIFO, os.SCHED_RR, os.SCHED_OTHER
NORMAL = [(OTHER, 0)] * 3


@pytest.mark.parametrize(
    ("parameters", "loop_alone", "permits", "cpus", "scheduled"),
    [
        # The calling thread, the one of Fast DDS that polls, and another of the middleware.
        ({}, False, True, [{1, 2, 3}] * 3, NORMAL),
        ({"priority": 40}, False, True, [{1, 2, 3}] * 3, [(FIFO, 40), (ROUND, 39), (FIFO, 40)]),
        ({"priority": 40, "cpus": "loop"}, False, True, [{3}] * 3, [(FIFO, 40), (ROUND, 39), (FIFO, 40)]),
        ({"priority": 40, "cpus": "loop"}, True, True, [{3}, {0, 1}, {0, 1}], [(FIFO, 40), (ROUND, 38), (FIFO, 39)]),
        ({"priority": 40, "cpus": "loop"}, True, False, [{3}] * 3, NORMAL),
        ({"priority": 0, "cpus": "loop"}, True, True, [{3}] * 3, NORMAL),
        ({"priority": 40, "cpus": "rest"}, False, True, [{0, 1}] * 3, [(FIFO, 39), (ROUND, 38), (FIFO, 39)]),
        ({"priority": 2, "cpus": "rest"}, False, True, [{0, 1}] * 3, [(FIFO, 1), (ROUND, 1), (FIFO, 1)]),
        ({"priority": 1, "cpus": "rest"}, False, True, [{0, 1}] * 3, [(FIFO, 1), (ROUND, 1), (FIFO, 1)]),
        ({"priority": 1, "cpus": "loop"}, True, True, [{3}, {0, 1}, {0, 1}], [(FIFO, 1), (ROUND, 1), (FIFO, 1)]),
        ({"cpus": "2,3"}, True, True, [{2, 3}] * 3, NORMAL),
    ],
)
@pytest.mark.parametrize("name", ["/cell", ""], ids=["of a graph", "of none"])
def test_each_thread_gets_the_cpus_and_the_priority_that_keep_it_from_holding_up_the_loop(
    tmp_path, monkeypatch, parameters, loop_alone, permits, cpus, scheduled, name
):
    machine = Machine(tmp_path, monkeypatch, permits)
    refusals = realtime.apply(RealtimeParameters(**parameters), machine.done.append, name, loop_alone)
    assert [allowed for allowed, *_ in machine.threads.values()] == cpus
    assert [(policy, priority) for _, policy, priority in machine.threads.values()] == scheduled
    assert len(refusals) == (not permits) and machine.done == []


@pytest.mark.parametrize(("loops", "rest"), [({1, 3}, {0, 2}), ({0, 1, 2, 3}, {0, 1, 2}), (set(), {0, 1, 2})])
def test_rest_is_what_no_loop_has_or_else_what_loops_of_other_graphs_have(tmp_path, monkeypatch, loops, rest):
    machine = Machine(tmp_path, monkeypatch, True)
    monkeypatch.setattr(realtime, "loop_cpus", lambda: loops)
    realtime.apply(RealtimeParameters(cpus="rest"))
    assert machine.getaffinity(0) == rest
    # A machine with a single CPU.
    monkeypatch.setattr(realtime, "left_behind", set)
    machine.setaffinity(0, {3})
    monkeypatch.setattr(realtime, "loop_cpus", lambda: loops & {3})
    realtime.apply(RealtimeParameters(cpus="rest"))
    assert machine.getaffinity(0) == {3}


def test_memory_sleep_and_other_programs_are_left_alone_unless_asked_for(tmp_path, monkeypatch):
    machine = Machine(tmp_path, monkeypatch, True)
    asked = RealtimeParameters(cpus="1", lock_memory=True, keep_awake=True, exclusive=True)
    assert realtime.apply(asked, machine.done.append) == []
    assert machine.done == ["_lock_memory", "_keep_awake", "off [1]"]
    monkeypatch.setattr(realtime, "keep_others_off", Mock(side_effect=OSError("there is no other CPU")))
    (refusal,) = realtime.apply(RealtimeParameters(exclusive=True))
    assert "no other CPU" in refusal and "realtime.cpus" in refusal
    # What a thread of the node's own does holds up no loop.
    started = threading.Event()
    helper = threading.Thread(target=started.wait, daemon=True)
    helper.start()
    machine.threads[helper.native_id] = [{1}, OTHER, 0]
    (tmp_path / str(helper.native_id)).mkdir()
    (tmp_path / str(helper.native_id) / "comm").write_text("python")
    assert realtime.apply(RealtimeParameters(priority=40)) == []
    helper_then = machine.threads[helper.native_id]
    started.set()
    helper.join()
    assert helper_then == [{1}, OTHER, 0]


@pytest.mark.parametrize(("result", "refused"), [(0, 0), (-1, 1)])
def test_memory_that_the_system_does_not_lock_is_refused_with_its_reason(monkeypatch, result, refused):
    library = Mock(mlockall=Mock(return_value=result))
    monkeypatch.setattr(realtime.ctypes, "CDLL", lambda *_, **__: library)
    monkeypatch.setattr(realtime.ctypes, "get_errno", lambda: errno.ENOMEM)
    refusals = realtime.apply(RealtimeParameters(lock_memory=True))
    assert len(refusals) == refused and all(os.strerror(errno.ENOMEM) in words for words in refusals)
    # MCL_CURRENT | MCL_FUTURE of Linux: what is mapped now and later.
    library.mlockall.assert_called_once_with(3)


def test_cpus_that_cannot_be_had_are_refused():
    before = os.sched_getaffinity(0)
    for cpus in ("4095", "none", "0,", "-1"):
        (refusal,) = realtime.apply(RealtimeParameters(cpus=cpus))
        assert f"CPUs '{cpus}'" in refusal and "Remedy" in refusal
    assert os.sched_getaffinity(0) == before


def test_the_request_to_keep_awake_is_held_open_or_its_refusal_said(monkeypatch, tmp_path):
    file = tmp_path / "cpu_dma_latency"
    monkeypatch.setattr(realtime, "_CPU_LATENCY", str(file))
    assert realtime.apply(RealtimeParameters(keep_awake=True)) == []
    assert file.read_bytes() == bytes(4) and not realtime._held[-1].closed
    realtime._held.pop().close()
    monkeypatch.setattr(realtime, "_CPU_LATENCY", str(tmp_path / "none" / "file"))
    (refusal,) = realtime.apply(RealtimeParameters(keep_awake=True))
    assert "udev" in refusal


def test_driver_and_controller_are_put_on_the_cpu_of_the_loop_and_the_others_beside_it():
    nodes = ("driver", "feedforward", "controller", "logger", "cell")
    assert [place(node) for node in nodes] == [LOOP, REST, LOOP, REST, REST]
