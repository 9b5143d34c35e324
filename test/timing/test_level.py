"""The level of a node's diagnostics: losses, late cycles and errors show, and are remembered for five reports."""

import itertools

from straightcomp_ros.timing.node_timing import Level, Levels


def levels_of(*reports):
    """The level of each report of (new samples, newly lost, new overruns, ms newly stalled, error)."""
    levels = Levels()
    counters = (itertools.accumulate(counts) for counts in zip(*(report[:4] for report in reports), strict=True))
    errors = [report[4] for report in reports]
    return [levels.next(*report)[0] for report in zip(*counters, errors, strict=True)]


CLEAN, LOSSY, BROKEN = (2000, 0, 0, 0, False), (2000, 1, 0, 0, False), (2000, 0, 0, 0, True)


def test_a_node_that_loses_nothing_and_is_in_time_is_ok_from_its_first_report():
    assert levels_of(*[CLEAN] * 8) == [Level.OK] * 8


def test_one_lost_sample_is_a_warning_until_five_reports_were_clean():
    assert levels_of(CLEAN, LOSSY, *[CLEAN] * 6) == [Level.OK, *[Level.WARN] * 5, Level.OK, Level.OK]


def test_a_loss_that_repeats_starts_the_five_clean_reports_anew():
    assert levels_of(LOSSY, *[CLEAN] * 3, LOSSY, *[CLEAN] * 5)[4:] == [Level.WARN] * 5 + [Level.OK]


def test_an_error_lasts_as_long_as_it_does_and_leaves_a_warning():
    assert levels_of(BROKEN, BROKEN, *[CLEAN] * 5) == [Level.ERROR] * 2 + [Level.WARN] * 4 + [Level.OK]


def test_overruns_are_a_warning_only_beyond_one_percent_of_the_new_samples():
    assert levels_of(CLEAN, (2000, 0, 20, 0, False), (2000, 0, 20, 0, False)) == [Level.OK] * 3
    assert levels_of(CLEAN, (2000, 0, 21, 0, False)) == [Level.OK, Level.WARN]


def test_the_words_give_what_is_new_since_the_last_report():
    levels = Levels()
    assert levels.next(2000, 3, 0, 0, False)[1].startswith("3 samples lost")
    assert levels.next(4000, 5, 0, 0, False)[1].startswith("2 samples lost")
    assert levels.next(6000, 5, 100, 0, False)[1].startswith("100 overruns")
    assert levels.next(8000, 5, 250, 0, False)[1].startswith("150 overruns")
    assert levels.next(10_000, 5, 250, 0, False)[1].startswith("running again")
    assert levels.next(12_000, 5, 250, 0, True)[1] == ""


def test_a_loss_tells_more_than_late_cycles_and_an_error_more_than_both():
    levels = Levels()
    assert "lost" in levels.next(2000, 1, 2000, 0, False)[1]
    assert levels.next(4000, 2, 4000, 0, True) == (Level.ERROR, "")


def test_a_node_without_new_samples_that_missed_a_cycle_is_late():
    assert levels_of(CLEAN, (0, 0, 1, 0, False)) == [Level.OK, Level.WARN]


def test_the_host_may_hold_a_loop_up_for_ten_milliseconds_a_second():
    levels = Levels()
    assert levels.next(2000, 0, 0, 10, False) == (Level.OK, "running")
    assert levels.next(4000, 0, 0, 21, False) == (Level.WARN, "the host held the loop up for 11 ms in the last second")
