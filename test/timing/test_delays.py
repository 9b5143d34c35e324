"""Durations in a histogram, samples that did not arrive, and waits for a CPU."""

import math
import os
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.timing.delays import NOTHING, CpuWait, Distribution, Histogram, StampGaps, ThreadWaits

PERIOD = 500_000


def recorded(values):
    histogram = Histogram()
    for value in values:
        histogram.record(value)
    return histogram.take()


@given(st.lists(st.integers(0, 2**39), min_size=1, max_size=300), st.sampled_from([50.0, 90.0, 99.0, 99.9, 100.0]))
def test_a_percentile_lies_within_six_percent_of_the_sorted_values(values, percent):
    rank = max(math.ceil(percent / 100.0 * len(values)), 1)
    exact = sorted(values)[rank - 1]
    found = recorded(values).percentiles_us([percent])[0] * 1e3
    assert abs(found - exact) <= exact / 16 + 1


@pytest.mark.parametrize("count", [20, 4096])
def test_percentiles_of_durations_that_are_evenly_spread_are_evenly_spread_too(count):
    percents = [0.0, 1.0, 30.0, 50.0, 77.7, 99.0, 100.0]
    evenly = [min(percent / 100.0 * count, count - 1) * 1e-3 for percent in percents]
    assert recorded(range(count)).percentiles_us(percents) == pytest.approx(evenly, rel=1e-12)


@given(st.lists(st.integers(-5, 2**45), max_size=50), st.lists(st.integers(0, 2**30), max_size=50))
def test_a_sum_of_histograms_is_the_histogram_of_all_and_survives_its_text(first, second):
    both = recorded(first) + Distribution.from_text(recorded(second).to_text())
    together = recorded(first + second)
    assert both == together and sum(both.counts.values()) == len(first) + len(second)


def test_taking_starts_anew_and_nothing_has_no_percentile():
    histogram = Histogram()
    histogram.record(1000)
    assert sum(histogram.take().counts.values()) == 1
    assert histogram.take() == NOTHING and math.isnan(NOTHING.largest_us)
    for percents in ([], [50.0, 90.0, 100.0]):
        assert len(recorded([3, 5]).percentiles_us(percents)) == len(percents)
        assert [math.isnan(found) for found in NOTHING.percentiles_us(percents)] == [True] * len(percents)


def test_a_duration_below_32_ns_is_known_exactly_and_one_beyond_18_minutes_counts_as_18():
    assert dict(recorded(range(32)).counts) == dict.fromkeys(range(32), 1)
    assert dict(recorded([-7]).counts) == {0: 1}
    longest = recorded([2**40 - 1])
    assert recorded([2**41]) == longest
    assert longest.largest_us == pytest.approx(2**40 * 1e-3)
    assert Distribution.from_text(longest.to_text()) == longest


@pytest.mark.parametrize("text", ["", "x", "5 9999:1", "5 592:1", "5 -1:1", "5 1:0", "5 3"])
def test_a_text_that_is_no_histogram_is_refused(text):
    with pytest.raises(ValueError):
        Distribution.from_text(text)


@given(st.integers(1, 10**7), st.sets(st.integers(3, 200), max_size=60), st.integers(0, 10**18))
def test_every_sample_that_is_left_out_is_counted_once(period, left_out, start):
    gaps = StampGaps()
    for k in range(202):
        if k not in left_out:
            gaps.see(start + k * period)
            gaps.see(start + k * period)
    assert gaps.lost == len(left_out)


@pytest.mark.parametrize(
    ("stamps", "lost"),
    [
        ([0, 1, 3], 1),
        ([start + k * PERIOD for start in (10**18, 5 * 10**17, 2 * 10**18) for k in range(10)], 0),
        ([0, PERIOD, 2 * PERIOD, PERIOD + 10**10], 19_998),
        ([0, PERIOD, 2 * PERIOD, 2 * PERIOD + 10**10], 0),
        ([0, 1, None, 100, 102], 1),
    ],
    ids=["first stamp", "a source that starts anew", "below ten seconds", "silent for longer", "left out on purpose"],
)
def test_samples_lost_within_ten_seconds_are_counted_but_for_a_restart_of_the_source_and_an_interruption(stamps, lost):
    gaps = StampGaps()
    for stamp in stamps:
        gaps.interrupt() if stamp is None else gaps.see(stamp)
    assert gaps.lost == lost


def test_the_longest_wait_of_a_thread_from_look_to_look_counts_once_it_was_seen_and_while_it_lives(tmp_path):
    waited_ns = {}

    def wait(thread, ns):
        waited_ns[thread] = waited_ns.get(thread, 0) + ns
        (tmp_path / thread).mkdir(exist_ok=True)
        # The scheduler writes no new file: who has it open reads the new numbers.
        file = tmp_path / thread / "schedstat"
        with open(file, "r+" if file.exists() else "w") as output:
            output.write(f"123456789 {waited_ns[thread]} 42\n")

    wait("11", 5_000_000_000)
    wait("12", 1_000_000_000)
    waits = ThreadWaits(tmp_path)
    cpu_wait, of_another_node = CpuWait(waits), CpuWait(waits)
    assert cpu_wait.take_us() == of_another_node.take_us() == 0.0  # each looks at a share of the threads
    for thread, ns in (("11", 3_000_000), ("12", 180_000_000), ("11", 7_000_000)):
        wait(thread, ns)
        cpu_wait.look()
        of_another_node.look()
    assert cpu_wait.take_us() == of_another_node.take_us() == pytest.approx(180_000.0)
    del of_another_node
    assert cpu_wait.take_us() == 0.0
    wait("13", 900_000_000)
    (tmp_path / "11" / "schedstat").write_text("")  # ended
    wait("12", 4_000_000)
    assert cpu_wait.take_us() == pytest.approx(4_000.0)
    wait("13", 2_000_000)
    assert cpu_wait.take_us() == pytest.approx(2_000.0)
    for file in waits._files.values():
        file.close()
    # A system without these counts.
    assert CpuWait(ThreadWaits(tmp_path / "absent")).take_us() == 0.0


def test_linux_counts_a_process_that_others_keep_from_its_cpu():
    """Two threads that both want one CPU wait for each other."""
    cpu = min(os.sched_getaffinity(0))
    # A digest of much data is made without the interpreter's lock.
    code = f"""
import hashlib, os, threading
from straightcomp_ros.timing.delays import CpuWait
os.sched_setaffinity(0, {{{cpu}}})
waited, data = CpuWait(), bytes(1 << 20)
threads = [threading.Thread(target=lambda: [hashlib.sha256(data) for _ in range(200)]) for _ in range(2)]
[thread.start() for thread in threads]
waited.take_us()
[thread.join(0.05) or waited.look() for thread in threads]
print(waited.take_us())
"""
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert float(printed.stdout) > 0.0
