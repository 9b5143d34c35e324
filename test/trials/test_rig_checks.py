"""The checks of the rigs on the running graph, with a stand that answers as the test says: each fails when it must."""

import random
from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest

pytest.importorskip("rclpy")


from straightcomp_ros.safety.faults import Fault
from trials import soak as soak_run
from trials.faults import row_of, trials_of
from trials.soak import HELD_UP, Look, Soak, gaps, grown
from trials.stand import Seen, Stand

NOW, SECOND = 2_000_000_000_000_000_000, 10**9


@pytest.fixture
def stand():
    """A graph at work, as far as its fields are not changed; it waits for nothing."""
    stand = Mock(
        spec=Stand, node=Mock(), condition="on", fault=None, tripped=None, failures=[], answers_lost=0, about=""
    )
    stand.names = ("driver", "feedforward", "controller", "logger")
    stand.until.side_effect = lambda condition, seconds=0.0: condition()
    stand.signal.return_value, stand.enable.return_value = NOW, False
    for real in (Stand.must_not_switch_on, Stand.fail):
        setattr(stand, real.__name__, partial(real, stand))
    return stand


def latch(stand, fault):
    stand.condition, stand.fault = "fault", Seen(fault, NOW)


def failures_of(stand, check, *arguments):
    stand.failures.clear()
    check(*arguments)
    return list(stand.failures)


@pytest.fixture
def soak(stand):
    return Soak(stand, random.Random(1), 2000, lambda begin, end: 0.0, ("one.csv",))


def test_a_row_of_faults_is_green_only_if_each_was_found_in_time_with_all_that_must_follow():
    trial = trials_of(False)[0]

    def row(injected=2, times_ms=(1.0, 3.0), failures=()):
        return row_of(trial, injected, times_ms, failures)

    limit = row()["limit_ms"]
    expected = {"name": trial.name, "injected": 2, "detected": 2, "median_ms": 2.0, "max_ms": 3.0, "green": True}
    assert expected.items() <= row().items()
    for bad in (
        {"injected": 3},
        {"times_ms": (1.0, limit + 1.0)},
        {"failures": ["not latched"]},
        {"injected": 0, "times_ms": ()},
    ):
        assert not row(**bad)["green"]


def test_a_fault_that_must_be_latched_must_have_the_right_name_and_keep_the_amplifier_off(soak, stand):
    soak.killable, kill = ["controller"], partial(failures_of, stand, soak_run.ACTIONS["SIGKILL"], soak)
    assert "command_timeout was not found" in kill()[0]
    latch(stand, Fault.X_JUMP)
    assert "command_timeout was not found" in kill()[0]
    for fault in (Fault.COMMAND_TIMEOUT, Fault.Y_OUT_OF_RANGE):
        latch(stand, fault)
        assert (
            kill() == [] and failures_of(stand, soak.check, HELD_UP) == [] and soak.counts["faults"][fault.label] == 1
        )
    stand.enable.return_value = True
    assert "could be switched on" in kill()[0]


def test_an_amplifier_that_may_not_be_off_is_a_failure(soak, stand):
    assert failures_of(stand, soak.check) == []
    stand.condition = "off"
    assert "the amplifier is 'off'" in failures_of(stand, soak.check)[0]
    assert failures_of(stand, soak.check, HELD_UP)
    latch(stand, Fault.SAMPLE_TIMEOUT)
    assert failures_of(stand, soak.check, HELD_UP) == []
    assert "'sample_timeout' was latched; none may" in failures_of(stand, soak.check)[0]
    # One that a computer made that stood still is counted apart, and another fault is not.
    soak._stalled = lambda begin, end: 120.0
    assert failures_of(stand, soak.check) == [] and soak.counts["faults_in_stalls"] == {"sample_timeout": 1}
    latch(stand, Fault.TWO_CONTROLLERS)
    assert failures_of(stand, soak.check)


@pytest.mark.parametrize(
    ("spans", "missing"),
    [
        ([(-1.0, 11.0)], []),
        ([(-1.0, 5.0), (5.5, 11.0)], []),
        ([(-1.0, 5.0), (6.0, 8.0)], [(5.0, 1.0), (8.0, 2.0)]),
        ([], [(0.0, 10.0)]),
    ],
)
def test_a_longer_time_without_samples_in_a_recording_that_was_complete_is_missing(spans, missing):
    stamps = [NOW + k * 2_000_000 for begin, end in spans for k in range(round(begin * 500), round(end * 500))]
    found = gaps(np.array(stamps[::-1], np.int64), [(NOW, NOW + 10 * SECOND), (NOW - 5 * SECOND, NOW - 5 * SECOND)])
    assert [((begin - NOW) / SECOND, length) for begin, length in found] == [
        (pytest.approx(begin, abs=0.01), pytest.approx(length, abs=0.01)) for begin, length in missing
    ]


@pytest.mark.parametrize(
    ("last", "words"),
    [
        ((22, 13, 202.0), []),
        ((23, 13, 200.0), ["driver has 23 descriptors after 22"]),
        ((22, 14, 200.0), ["driver has 14 threads after 13"]),
        ((22, 13, 261.0), ["driver has 261 memory_mb after 200"]),
    ],
)
def test_one_descriptor_or_thread_more_at_the_end_is_a_failure_and_memory_once_it_is_more_than_histories(last, words):
    assert grown("driver", Look(22, 13, 200.0), Look(*last)) == words


def test_a_run_has_passed_only_if_something_was_done_and_nothing_failed(soak, stand):
    assert not soak.figures([])["passed"]
    soak.counts["actions"]["split"] += 1
    assert soak.figures([])["passed"] and not soak.figures(["a bag has a gap"])["passed"]
    soak.looks["driver", 7] = Look(22, 13, 200.0), Look(23, 13, 200.0)
    assert not soak.figures([])["passed"] and len(soak.figures([])["failures"]) == 1
    soak.looks.clear()
    stand.fail("the amplifier is 'off'")
    assert soak.figures([])["failures"] == ["the amplifier is 'off'"]
