"""The check of a map by another survey: within its uncertainty, or another guide's."""

import numpy as np
import pytest

from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.survey import Run, Survey, SurveyError
from straightcomp_ros.tuning.survey.survey_check import survey_check

NOISE = 0.02e-6
SHIPPED = load_map()


def measured(guide, seed, *, runs=2, points=12, noise=0.1e-6, scale=1.0):
    """``guide`` at some places, plus a line of its own."""
    random = np.random.default_rng(seed)
    x = np.linspace(guide.span[0] + 0.01, guide.span[1] - 0.01, points)
    line = 3e-6 + 5e-6 * x
    found = [scale * guide.deviations(x) + line + noise * random.standard_normal(points) for _ in range(runs)]
    directions = ("forward", "backward")
    return Survey(tuple(Run(str(k), directions[k % 2], x, one) for k, one in enumerate(found)), "check.csv")


def test_the_right_map_passes_whatever_the_uncertainty_of_the_check():
    for noise in (1e-9, 0.1e-6, 1e-6):
        assert all(survey_check(SHIPPED, measured(SHIPPED, seed, noise=noise), NOISE).agrees for seed in range(40))


@pytest.mark.parametrize("scale", [0.0, 0.5, 2.0, -1.0], ids=["straight", "half", "twice", "opposite"])
def test_a_map_of_another_guide_is_found(scale):
    for seed in range(20):
        found = survey_check(SHIPPED, measured(SHIPPED, seed, scale=scale), NOISE)
        assert not found.agrees and found.opposite is (scale < 0.0)
        assert found.difference > 3.0 * found.allowed


def test_another_zero_of_x_is_found_and_a_check_too_coarse_to_tell_says_how_coarse_it_is():
    x = np.linspace(*SHIPPED.span, 200)
    other = StraightnessMap(Survey((Run("1", "forward", x + 0.1, SHIPPED.deviations(x)),)), MapParameters())
    assert not survey_check(other, measured(SHIPPED, 1), NOISE).agrees
    coarse = survey_check(SHIPPED, measured(SHIPPED, 1, noise=10e-6), NOISE)
    assert coarse.agrees and coarse.allowed > coarse.guide


def test_a_single_run_and_a_check_outside_of_the_map_are_refused():
    with pytest.raises(SurveyError, match=r"check survey check.csv: has one run; allowed: >= 2"):
        survey_check(SHIPPED, measured(SHIPPED, 1, runs=1), NOISE)
    far = measured(SHIPPED, 1)
    moved = Survey(tuple(Run(run.name, run.direction, run.x + 1.2, run.deviation) for run in far.runs), "check.csv")
    with pytest.raises(SurveyError, match=r"check survey check.csv: \d points between 0 mm and .*where the map is"):
        survey_check(SHIPPED, moved, NOISE)
