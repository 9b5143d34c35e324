"""Which missed periods are the loop's own, and which the host's."""

import pytest

from straightcomp_ros.timing.node_timing import MissedPeriods


@pytest.mark.parametrize("rate", [500, 2000, 8000])
def test_short_gaps_are_overruns_and_long_ones_stalls_at_every_rate(rate):
    missed = MissedPeriods(10**9 // rate)
    below, beyond = rate // 500 - 1, rate // 500
    missed.count(below)
    missed.count(0)
    assert missed.report() == {"overruns": below, "stalls": 0, "stalled_ms": 0}
    missed.count(beyond)
    missed.count(10 * beyond)
    assert missed.report() == {"overruns": below, "stalls": 2, "stalled_ms": 22}
