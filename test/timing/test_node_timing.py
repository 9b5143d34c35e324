"""The level of a node's diagnostics, its missed periods, and what its reports add up to."""

import math
import random
import re

import numpy as np
import pytest
from bag_of_rows import STORE

from straightcomp_ros.timing.delays import NOTHING, Histogram
from straightcomp_ros.timing.node_timing import (
    CPU_CORES,
    CPU_WAIT,
    CPUS,
    NORMAL,
    PROCESS,
    REALTIME_LIMIT,
    REFUSED,
    SCHEDULING,
    HeldUp,
    Level,
    Levels,
    MissedPeriods,
    Report,
    amplifier_on,
    blamed,
    count,
    held_up,
    reporting_node,
    summarise,
    written,
)
from straightcomp_ros.timing.realtime import realtime_limit


def levels_of(*reports):
    """Level and text of each report of new samples, newly lost ones, new overruns, ms newly stalled, and an error."""
    levels, values = Levels(), {}
    for *new, error in reports:
        counters = zip(("samples", "lost_samples", "overruns", "stalled_ms"), new, strict=True)
        values.update({name: values.get(name, 0) + count for name, count in counters}, error=error)
        yield levels.next(values)


CLEAN, LOSSY, BROKEN = (2000, 0, 0, 0, ""), (2000, 1, 0, 0, ""), (2000, 0, 0, 0, "coil burnt")


@pytest.mark.parametrize(
    ("reports", "levels"),
    [
        ([CLEAN, LOSSY, *[CLEAN] * 6], [Level.OK, *[Level.WARN] * 5, Level.OK, Level.OK]),
        ([LOSSY, *[CLEAN] * 3, LOSSY, *[CLEAN] * 5], [*[Level.WARN] * 9, Level.OK]),
        ([BROKEN, BROKEN, *[CLEAN] * 5], [*[Level.ERROR] * 2, *[Level.WARN] * 4, Level.OK]),
        # Overruns in one percent of the samples, and stalls of ten milliseconds, are allowed, also in the first second.
        ([(2000, 0, 20, 0, "")] * 3, [Level.OK] * 3),
        ([(2000, 0, 21, 0, "")] * 2, [Level.WARN] * 2),
        ([(2000, 0, 0, 10, "")] * 3, [Level.OK] * 3),
        ([(2000, 0, 0, 11, "")] * 2, [Level.WARN] * 2),
        # A node without new samples that missed a cycle is late.
        ([CLEAN, *[(0, 0, 1, 0, "")] * 2], [Level.OK, Level.WARN, Level.WARN]),
    ],
)
def test_a_problem_or_an_error_is_a_warning_until_five_reports_in_a_row_were_clean(reports, levels):
    assert [level for level, _ in levels_of(*reports)] == levels


def test_the_words_give_what_is_new_since_the_last_report_and_a_loss_before_late_cycles():
    reports = {
        (2000, 3, 2000, 0, ""): "3 samples lost",
        (2000, 2, 0, 0, ""): "2 samples lost",
        (2000, 0, 100, 0, ""): "100 overruns",
        CLEAN: "running again",
        (2000, 0, 0, 11, ""): "the host held the loop up for 11 ms",
        (2000, 4, 2000, 0, "coil burnt"): "coil burnt",
    }
    for (_, found), words in zip(levels_of(*reports), reports.values(), strict=True):
        assert found.startswith(words)


def test_the_levels_are_those_of_diagnostics():
    theirs = STORE.types["diagnostic_msgs/msg/DiagnosticStatus"]
    assert [(level.name, level.value) for level in Level] == [
        (name, getattr(theirs, name)) for name in ("OK", "WARN", "ERROR")
    ]


@pytest.mark.parametrize(("text", "number"), [("0", 0), (str(2**63 - 1), 2**63 - 1), (str(2**63), 0), ("9" * 19, 0)])
def test_a_counter_is_known_up_to_the_largest_that_ros_has(text, number):
    assert count({"samples": text}, "samples") == number


@pytest.mark.parametrize("rate", [500, 2000, 8000])
def test_short_gaps_are_overruns_and_long_ones_stalls_at_every_rate(rate):
    missed = MissedPeriods(10**9 // rate)
    below, beyond = rate // 500 - 1, rate // 500
    for periods in (below, 0, beyond, 10 * beyond):
        missed.count(periods)
    assert missed.report() == {"overruns": below, "stalls": 2, "stalled_ms": 22}
    # A wake-up that came a period late is none of the loop's own work, and one after which none was missed is none.
    period, short = 10**9 // rate, MissedPeriods(10**9 // rate)
    for periods, late_ns in ((1, period - 1), (1, period), (0, 10 * period)):
        short.count(periods, late_ns)
    assert (short.overruns, short.stalls) == ((1, 1) if period < 2_000_000 else (0, 2))


def test_a_status_is_of_the_node_in_its_namespace():
    for status, namespace, node in (
        ("driver", "", "driver"),
        ("line/a/driver", "/line/a", "driver"),
        ("line/driver", "/line/a", ""),
        ("driver", "/line", ""),
        ("line/driver", "/", ""),
    ):
        assert reporting_node(status, namespace) == node


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
    shown = summary.to_display()
    assert (shown["rate_hz"], shown["overruns"], shown["lost_samples"]) == (pytest.approx(2000.0), 5, 15)
    assert max(shown["timer_error_us"].values()) == summary.timer_error.largest_us
    assert summarise(reports[:2]).rate_hz == pytest.approx(2000.0)
    # Without the report at one end; a single report, or two of the same time, have no rate.
    assert summarise(reports, 2 * 10**9 + 1, 7 * 10**9).overruns == 4
    assert summarise(reports, 2 * 10**9, 7 * 10**9 - 1).overruns == 4
    assert math.isnan(summarise(reports[:1]).rate_hz) and math.isnan(summarise(reports[:1] * 2).rate_hz)


def test_the_first_report_of_a_window_marks_its_beginning_and_counts_from_zero_what_it_does_not_have():
    reports, _ = reports_of(4)
    del reports[0].values["overruns"]
    for report, waited in zip(reports, ("900", "20", "50", "10"), strict=True):
        report.values[CPU_WAIT] = report.values["timer_error_max_us"] = waited
    summary = summarise(reports)
    assert summary.overruns == 3 and summary.held_up.no_cpu_us == 50.0


def test_a_driver_counts_from_the_first_report_with_its_amplifier_on_to_the_last():
    driver = [Report(time, {"amplifier": state}) for time, state in ((1, "off"), (2, "on"), (3, "on"), (4, "off"))]
    assert amplifier_on(driver) == (2, 3)
    begin, end = amplifier_on(driver[:1])
    assert begin <= 0 and end > 2 * 10**18


@pytest.mark.parametrize("value", ["n/a", "", "-1", "nan", "1e400", "9" * 5000, "²", "1:2:3 x"])
def test_a_value_that_another_program_wrote_counts_as_absent_and_ends_no_summary(value):
    names = ("samples", "overruns", "stalls", "lost_samples", "timer_error_max_us", "timer_error_histogram", CPU_WAIT)
    wrong = dict.fromkeys(names, value)
    summary = summarise([Report(0, wrong), Report(10**9, {**wrong, "overruns": "3"}), Report(2 * 10**9, wrong)])
    assert (summary.overruns, summary.lost_samples, summary.rate_hz) == (0, 0, 0.0)
    assert summary.timer_error == NOTHING and summary.held_up == HeldUp()


LONGEST_FIRST = "the controller got no CPU for 180 ms, the driver got no CPU for"


@pytest.mark.parametrize(
    ("scheduling", "nodes", "words", "remedy"),
    [
        (REFUSED, [(1e3, 2e3), (180e3, 200e3)], "the controller got no CPU for 180 ms", "doctor"),
        (NORMAL, [(7e3, 8e3), (180e3, 200e3)], f"{LONGEST_FIRST} 7 ms", "the parameter realtime.priority"),
        # Other programs do not hold up a node of real-time priority.
        ("FIFO 40", [(200e3, 300e3), (100.0, 20e3)], "the driver was late by 300 ms", "doctor"),
        (NORMAL, [(3e3, 4e3), (0.0, 0.0)], "", ""),
        # From ten samples at 2 kHz on.
        (NORMAL, [(5e3, 5e3)], "the driver got no CPU for 5 ms", "the parameter realtime.priority"),
        ("FIFO 40", [(0.0, 5e3)], "the driver was late by 5 ms", "doctor"),
        (NORMAL, [], "", ""),
    ],
)
def test_what_delayed_the_nodes_for_long_is_named_with_the_remedy(scheduling, nodes, words, remedy):
    named = blamed({name: HeldUp(*one, scheduling) for name, one in zip(("driver", "controller"), nodes, strict=False)})
    assert named.startswith(words) and named.endswith(remedy) and bool(named) is bool(words)


def report(wait_us, late_us, scheduling=NORMAL):
    return {CPU_WAIT: str(wait_us), "timer_error_max_us": str(late_us), SCHEDULING: scheduling}


LIMIT = (950e3, 1e6)
STOPPED = HeldUp(45e3, 46e3, "FIFO 40", "7", "1", 0.93, LIMIT)
KERNEL = "the kernel, the disk or the hypervisor"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "driver was stopped for 45 ms by the kernel's limit.*driver used 0.93 of CPU 1, allowed 0.95"),
        ({"limit": (0.0, 0.0)}, KERNEL),
        ({"cores": 0.6}, KERNEL),
        ({"no_cpu_us": 0.0}, KERNEL),  # the hypervisor stopped the whole machine
        ({"late_us": 55e3}, "driver was stopped for 45 ms by the kernel's limit"),
        ({"late_us": 100e3}, KERNEL),  # longer than the limit can: the rest of its period is 50 ms
        ({"scheduling": NORMAL}, "got no CPU for 45 ms; real-time priority was not requested"),
    ],
)
def test_a_stop_by_the_limit_for_real_time_tasks_is_named_with_what_used_it_up(changes, words):
    assert re.search(words, blamed({"driver": STOPPED._replace(**changes)}))


def test_nodes_on_one_cpu_use_up_its_limit_together_and_nodes_of_one_process_count_once():
    half = STOPPED._replace(cores=0.45)
    together = blamed({"driver": half, "controller": half._replace(process="8", no_cpu_us=0.0, cores=0.47)})
    assert "driver, controller used 0.92 of CPU 1" in together
    assert KERNEL in blamed({"driver": half, "controller": half})
    assert KERNEL in blamed({"driver": half, "controller": half._replace(process="8", cpus="0")})


def test_the_limit_is_read_from_reports_and_anything_else_in_its_place_is_none():
    values = {PROCESS: "7", CPUS: "1", CPU_CORES: "0.93", REALTIME_LIMIT: "950000/1000000"}
    assert held_up([report(45e3, 46e3, "FIFO 40") | values]) == STOPPED
    assert held_up([report(1, 1) | values | {REALTIME_LIMIT: "7/7"}]).limit == (7.0, 7.0)  # all of the period
    for text in ("", "-1", "950000", "x/y", "2/1", "/"):
        assert held_up([report(45e3, 46e3) | values | {REALTIME_LIMIT: text}]).limit == (0.0, 0.0)


@pytest.mark.parametrize(
    ("runtime", "release", "limit"),
    [("950000", "6.1.0-9", "950000/1000000"), ("-1", "6.1.0-9", ""), ("-1", "6.12.3", "950000/1000000")],
)
def test_what_the_kernel_leaves_to_real_time_tasks_is_read_from_its_settings(tmp_path, runtime, release, limit):
    assert realtime_limit(tmp_path) == ""
    for name, text in (("runtime", runtime), ("period", "1000000")):
        (tmp_path / f"sched_rt_{name}_us").write_text(f"{text}\n")
    assert realtime_limit(tmp_path, release) == limit


def test_a_node_got_no_cpu_for_as_long_as_both_its_lateness_and_the_scheduler_say():
    reports = [report(7000, 8000.0), report(40_000, 900.0), report(9000, 60_000.0, "FIFO 40"), {}]
    assert held_up(reports) == HeldUp(7000.0, 60_000.0, "FIFO 40")
    assert held_up([report(7000, "nan")]) == held_up([report("nan", "nan")]) == HeldUp(0.0, 0.0, NORMAL)
    assert held_up([{}]) == held_up([]) == HeldUp()
