"""A search that cannot go on from the likelier of its two first solutions goes on from the other one."""

from types import SimpleNamespace

import numpy as np
import pytest

from straightcomp_ros.tuning.identification import fit as fitting

DESCRIBED, SLID = 0.0, 1.0
SAMPLES = 4000


class ScriptedSearch:
    """Solutions stay where they began, with the surprise and errors that a test says."""

    def __init__(self, recording, path, unknowns, resolution):
        self.gains = np.ones((fitting.BURN_IN + SAMPLES, 4))

    def solve(self, start, missed):
        place = float(start[0])
        errors = 0.7 if missed not in self.fails.get(place, ()) else 1.9
        return fitting.Level(start, np.ones((SAMPLES, 1)), np.full(SAMPLES, errors), missed, self.surprises[place])

    def take_gains(self, vector, missed):
        pass

    def onward(self, level):
        return level.vector

    def residuals(self, vector):
        return np.full(SAMPLES, 0.7)


NONE, THIRD, LAST = fitting.MISSED[1:], fitting.MISSED[2:3], fitting.MISSED[3:]
"""Assumptions that fail."""
LIKELIER = {DESCRIBED: {DESCRIBED: -2.0, SLID: -1.0}, SLID: {DESCRIBED: -1.0, SLID: -2.0}}


@pytest.mark.parametrize(
    ("fails", "likelier", "found", "levels"),
    [
        ({DESCRIBED: NONE}, DESCRIBED, SLID, 4),
        ({DESCRIBED: NONE, SLID: NONE}, DESCRIBED, DESCRIBED, 1),
        ({DESCRIBED: LAST}, DESCRIBED, SLID, 4),
        ({DESCRIBED: LAST, SLID: LAST}, DESCRIBED, DESCRIBED, 3),
        ({DESCRIBED: THIRD}, DESCRIBED, DESCRIBED, 4),
        ({}, DESCRIBED, DESCRIBED, 4),
        ({}, SLID, SLID, 4),
    ],
)
def test_the_likelier_solution_is_followed_unless_the_other_one_leads_further(
    monkeypatch, fails, likelier, found, levels
):
    monkeypatch.setattr(ScriptedSearch, "fails", fails, raising=False)
    monkeypatch.setattr(ScriptedSearch, "surprises", LIKELIER[likelier], raising=False)
    monkeypatch.setattr(fitting, "Search", ScriptedSearch)
    monkeypatch.setattr(fitting, "sliding_start", lambda recording, unknowns: np.array([SLID]))
    recording, unknowns = SimpleNamespace(period_ns=500_000), SimpleNamespace(start=np.array([DESCRIBED]), free=(0,))
    solution = fitting.fit(recording, None, unknowns, 1e-7).solution
    assert solution.vector == [found] and solution.missed == fitting.MISSED[levels - 1]
