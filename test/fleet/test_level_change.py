"""Changes of a figure's level: found, dated, distinguished, and not seen where there are none; its trend."""

import numpy as np
import pytest
from scipy.signal import lfilter

from straightcomp_ros.fleet.maintenance.day_levels import Watched
from straightcomp_ros.fleet.maintenance.level_change import BASELINE, MONTH, baseline_of, changes_of_figure, trend_of

RISING, BOTH = Watched("error", "error", "µm"), Watched("friction", "friction", "A", falling=True)
DAYS, BEGIN = np.arange(200), 100
STEP, SPELL = 8.0 * (DAYS >= BEGIN), 8.0 * ((DAYS >= 60) & (DAYS < 80))


def change_of(values, watched):
    """The only change; None without one."""
    (change,) = changes_of_figure(values, watched) or [None]
    return change


def levels(seed=0):
    return 10.0 + np.random.default_rng(seed).standard_normal(DAYS.size)


def test_a_step_is_found_in_days_dated_to_the_day_and_distinguished_from_a_drift():
    change = change_of(levels() + STEP, RISING)
    assert change.step and change.lasting
    assert change.begin == BEGIN and BEGIN <= change.found <= BEGIN + 6
    assert change.before == pytest.approx(10.0, abs=0.7) and change.after == pytest.approx(18.0, abs=1.0)
    drift = change_of(levels() + 0.1 * np.maximum(DAYS - BEGIN, 0.0), RISING)
    assert not drift.step and abs(drift.begin - BEGIN) <= 15 and BEGIN < drift.found <= BEGIN + 50


def test_a_fall_is_a_change_only_where_that_is_watched():
    assert change_of(levels() - STEP, RISING) is None
    found = change_of(levels() - STEP, BOTH)
    assert found is not None and found.after < found.before


def test_scatter_a_single_bad_day_and_days_before_the_baseline_is_complete_are_no_change():
    assert [change_of(levels(seed), BOTH) for seed in range(40)].count(None) >= 39
    baseline = levels()[:BASELINE] * np.linspace(1.0, 50.0, BASELINE)
    for values in (baseline, np.full(DAYS.size, np.nan), levels() + 15.0 * (DAYS == BEGIN)):
        assert change_of(values, BOTH) is None


def test_days_without_the_figure_are_left_out():
    found = change_of(np.where(DAYS % 3, levels() + STEP, np.nan), RISING)
    assert found is not None and BEGIN <= found.begin <= BEGIN + 1


def test_a_figure_that_did_not_scatter_in_its_baseline_may_tremble():
    assert change_of(500.0 + 0.5 * (DAYS >= BEGIN), BOTH) is None
    assert change_of(500.0 + 50.5 * (DAYS >= BEGIN), BOTH) is not None


def test_each_change_has_an_alarm_and_none_hides_another():
    first, second = changes_of_figure(levels() + SPELL + STEP, BOTH)
    assert first.begin == 60 and not first.lasting and 80 <= first.ended <= 90
    assert first.after == pytest.approx(18.0, abs=1.0)
    assert second.begin == BEGIN and second.lasting
    other_way = changes_of_figure(levels() + SPELL - STEP, BOTH)
    assert [one.after > one.before for one in other_way] == [True, False]
    # Grease beyond the baseline, or a computer that is faster than ever: the rise is over.
    rise, fall = changes_of_figure(levels() + 8.0 * (DAYS >= 60) - 2.0 * STEP, BOTH)
    assert not rise.lasting and rise.after > rise.before and (fall.begin, fall.lasting) == (BEGIN, True)
    assert not change_of(levels() + 8.0 * (DAYS >= 60) - 2.0 * STEP, RISING).lasting


def test_an_alarm_knows_nothing_of_later_days():
    values = levels() + SPELL
    whole = change_of(values, BOTH)
    assert changes_of_figure(values[: whole.found], BOTH) == []
    then, before = (change_of(values[:count], BOTH) for count in (whole.found + 1, whole.ended))
    assert then.found == whole.found and then.lasting
    assert before.lasting and not whole.lasting


def weather(seed, days, kept, start=0):
    """Days (days,) of deviation 1 or so, each with the fraction ``kept`` of the day before; ``start`` days run in."""
    random = np.random.default_rng(seed)
    noise = np.sqrt(1.0 - kept**2) * random.standard_normal(start + days - 1)
    return lfilter([1.0], [1.0, -kept], np.concatenate([[0.0], noise]))[start:]


def test_days_that_are_alike_leave_more_room():
    """With weather, four weeks scatter less than a year does: a chart that takes them as they are is too narrow."""

    def sigma(kept, seed):
        values = weather(seed, BASELINE, kept, start=50)
        return baseline_of(10.0 + values, BOTH).sigma / max(float(values.std()), 0.01)

    alike, independent = (np.mean([sigma(kept, seed) for seed in range(30)]) for kept in (0.8, 0.0))
    assert alike > 1.2 and independent < 1.1


QUARTER = np.arange(91)


def test_the_slope_is_that_of_a_month_whatever_a_bad_week_says():
    levels = 5.0 + 0.2 * QUARTER / MONTH + 0.01 * np.random.default_rng(1).standard_normal(91)
    levels[40:47] += 30.0
    trend = trend_of(QUARTER, levels)
    assert trend is not None and trend.certain
    assert trend.slope == pytest.approx(0.2, abs=0.03) and trend.low < trend.slope < trend.high
    assert trend.level == pytest.approx(5.6, abs=0.05)


def test_days_that_are_alike_make_no_certain_trend_too_often():
    assert sum(trend_of(QUARTER, weather(seed, 91, kept=0.8)).certain for seed in range(60)) <= 15


def test_too_few_weeks_give_none():
    assert trend_of(QUARTER[:28], np.ones(28)) is None
    assert trend_of(QUARTER, np.full(91, np.nan)) is None
