"""The trend of a figure and its interval."""

import numpy as np
import pytest

from straightcomp_ros.fleet.maintenance.level_change import MONTH, trend_of

DAYS = np.arange(91)


def test_the_slope_is_that_of_a_month_whatever_a_bad_week_says():
    levels = 5.0 + 0.2 * DAYS / MONTH + 0.01 * np.random.default_rng(1).standard_normal(91)
    levels[40:47] += 30.0
    trend = trend_of(DAYS, levels)
    assert trend is not None and trend.certain
    assert trend.slope == pytest.approx(0.2, abs=0.03) and trend.low < trend.slope < trend.high
    assert trend.level == pytest.approx(5.6, abs=0.05)


def test_days_that_are_alike_make_no_certain_trend_too_often():
    def certain(seed):
        random = np.random.default_rng(seed)
        weather = np.zeros(91)
        for day in range(1, 91):
            weather[day] = 0.8 * weather[day - 1] + random.standard_normal()
        found = trend_of(DAYS, weather)
        assert found is not None
        return found.certain

    assert sum(map(certain, range(60))) <= 15


def test_too_few_weeks_give_none():
    assert trend_of(DAYS[:28], np.ones(28)) is None
    assert trend_of(DAYS, np.full(91, np.nan)) is None
