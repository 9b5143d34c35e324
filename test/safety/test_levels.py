"""Levels of the diagnostics change when something has changed, not with each report."""

from straightcomp_ros.timing.level import Level, Levels


def test_a_lost_sample_warns_until_five_reports_were_clean():
    levels = Levels()
    reports = [(2000, 0), (4000, 3), (6000, 3), (8000, 3), (10000, 3), (12000, 3), (14000, 3), (16000, 3)]
    found = [levels.next(samples, lost, 0, False)[0] for samples, lost in reports]
    assert found == [Level.OK, *[Level.WARN] * 5, Level.OK, Level.OK]


def test_an_overrun_now_and_then_is_none_worth_a_warning_and_many_are():
    levels = Levels()
    assert levels.next(2000, 0, 20, False)[0] is Level.OK
    assert levels.next(4000, 0, 60, False) == (Level.WARN, "40 overruns in the last second")


def test_an_error_lasts_as_long_as_it_is_there_and_leaves_a_warning():
    levels = Levels()
    assert levels.next(2000, 0, 0, True)[0] is Level.ERROR
    assert [levels.next(2000, 0, 0, False)[0] for _ in range(5)] == [*[Level.WARN] * 4, Level.OK]
