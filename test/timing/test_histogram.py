"""Histogram of durations, gaps in stamps, and the reports made of them."""

import math
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.timing.delays import NOTHING, Distribution, Histogram, StampGaps
from straightcomp_ros.timing.node_timing import CPU_WAIT, HeldUp, Report, amplifier_on, summarise, written

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


@given(st.lists(st.integers(-5, 2**45), max_size=50), st.lists(st.integers(0, 2**30), max_size=50))
def test_a_sum_of_histograms_is_the_histogram_of_all_and_survives_its_text(first, second):
    both = recorded(first) + Distribution.from_text(recorded(second).to_text())
    together = recorded(first + second)
    assert both == together and sum(both.counts.values()) == len(first) + len(second)


def test_taking_starts_anew_and_nothing_has_no_percentile():
    histogram = Histogram()
    histogram.record(1000)
    assert sum(histogram.take().counts.values()) == 1
    empty = histogram.take()
    assert not empty.counts and math.isnan(empty.percentiles_us([50.0])[0]) and math.isnan(empty.largest_us)


def test_each_percentile_that_is_asked_for_is_answered_even_by_an_empty_histogram():
    for percents in ([], [50.0], [50.0, 90.0, 100.0]):
        assert len(NOTHING.percentiles_us(percents)) == len(recorded([3, 5]).percentiles_us(percents)) == len(percents)


def test_a_duration_below_32_ns_is_known_exactly():
    for duration in range(32):
        assert dict(recorded([duration]).counts) == {duration: 1}
    assert dict(recorded([-7]).counts) == {0: 1}


def test_what_is_longer_than_the_longest_bin_counts_as_18_minutes():
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


def test_a_restart_of_the_source_is_no_loss():
    gaps = StampGaps()
    for start in (10**18, 5 * 10**17, 2 * 10**18):
        for k in range(10):
            gaps.see(start + k * PERIOD)
    assert gaps.lost == 0


def test_samples_lost_within_ten_seconds_are_counted_and_a_longer_silence_is_a_restart():
    for silence, lost in ((10 * 10**9 - PERIOD, 19_998), (10 * 10**9, 0)):
        gaps = StampGaps()
        for stamp in (0, PERIOD, 2 * PERIOD, 2 * PERIOD + silence):
            gaps.see(stamp)
        assert gaps.lost == lost


def test_the_first_stamp_of_all_is_no_gap():
    gaps = StampGaps()
    gaps.see(0)
    gaps.see(1)
    gaps.see(3)
    assert gaps.lost == 1


def reports_of(seconds):
    histogram = Histogram()
    source = random.Random(1)
    reports, values = [], []
    for second in range(seconds):
        values.append([source.randrange(10**6) for _ in range(2000)])
        for value in values[-1]:
            histogram.record(value)
        counters = {"samples": 2000 * second, "overruns": second, "lost_samples": 3 * second}
        texts = {**counters, **written("timer_error", histogram.take())}
        reports.append(Report(second * 10**9, {key: str(text) for key, text in texts.items()}))
    return reports, values


def test_a_summary_has_the_percentiles_and_counts_of_its_window_alone():
    reports, values = reports_of(10)
    summary = summarise(reports, 2 * 10**9, 7 * 10**9)
    inside = np.concatenate(values[3:8])
    assert summary.rate_hz == pytest.approx(2000.0) and summary.overruns == 5 and summary.lost_samples == 15
    assert sum(summary.timer_error.counts.values()) == len(inside)
    assert summary.timer_error.largest_us == inside.max() * 1e-3
    assert summary.timer_error.percentiles_us([99])[0] == pytest.approx(np.percentile(inside, 99) * 1e-3, rel=0.06)
    assert summary.latency is NOTHING


def test_one_report_says_nothing_of_a_rate():
    assert math.isnan(summarise(reports_of(1)[0]).rate_hz)


def test_a_window_holds_the_reports_at_both_of_its_ends():
    reports, _ = reports_of(5)
    assert summarise(reports, 10**9, 3 * 10**9).overruns == 2
    assert summarise(reports, 10**9 + 1, 3 * 10**9).overruns == 1
    assert summarise(reports, 10**9, 3 * 10**9 - 1).overruns == 1


def test_what_a_first_report_does_not_count_yet_began_at_zero():
    (first, *_, last), _ = reports_of(4)
    del first.values["overruns"]
    assert summarise([first, last]).overruns == 3


def test_who_was_held_up_before_the_window_was_not_held_up_in_it():
    reports, _ = reports_of(4)
    for report, waited in zip(reports, ("900", "20", "50", "10"), strict=True):
        report.values[CPU_WAIT] = report.values["timer_error_max_us"] = waited
    assert summarise(reports).held_up.no_cpu_us == 50.0


def test_two_reports_of_the_same_time_have_no_rate():
    (report,), _ = reports_of(1)
    assert math.isnan(summarise([report, report]).rate_hz)


def test_a_driver_counts_from_the_first_report_with_its_amplifier_on_to_the_last():
    driver = [Report(time, {"amplifier": state}) for time, state in ((1, "off"), (2, "on"), (3, "on"), (4, "off"))]
    assert amplifier_on(driver) == (2, 3)
    begin, end = amplifier_on(driver[:1])
    assert begin <= 0 and end > 2 * 10**18


def test_a_summary_is_shown_in_hertz_and_microseconds():
    reports, values = reports_of(3)
    shown = summarise(reports).to_display()
    assert (shown["rate_hz"], shown["overruns"], shown["lost_samples"]) == (2000.0, 2, 6)
    assert max(shown["timer_error_us"].values()) == pytest.approx(max(values[1] + values[2]) * 1e-3)


@pytest.mark.parametrize("value", ["n/a", "", "-1", "nan", "1e400", "9" * 5000, "²", "1:2:3 x"])
def test_a_value_that_another_program_wrote_counts_as_absent_and_ends_no_summary(value):
    names = ("samples", "overruns", "stalls", "lost_samples", "timer_error_max_us", "timer_error_histogram", CPU_WAIT)
    wrong = dict.fromkeys(names, value)
    summary = summarise([Report(0, wrong), Report(10**9, {**wrong, "overruns": "3"}), Report(2 * 10**9, wrong)])
    assert (summary.overruns, summary.lost_samples, summary.rate_hz) == (0, 0, 0.0)
    assert summary.timer_error == NOTHING and summary.held_up == HeldUp()
