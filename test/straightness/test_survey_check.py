"""A check survey finds a map of another guide, whatever line it was measured against, and lets the right one pass."""

import numpy as np
import pytest

from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map, survey_check
from straightcomp_ros.straightness.survey import Run, Survey, SurveyError

NOISE = 0.02e-6
SHIPPED = load_map()


def measured(
    guide: StraightnessMap, seed: int, *, runs: int = 2, points: int = 12, noise: float = 0.1e-6, scale: float = 1.0
) -> Survey:
    """``guide`` at some places, beside a line of its own."""
    random = np.random.default_rng(seed)
    x = np.linspace(guide.span[0] + 0.01, guide.span[1] - 0.01, points)
    line = 3e-6 + 5e-6 * x
    found = [scale * guide.deviations(x) + line + noise * random.standard_normal(points) for _ in range(runs)]
    directions = ("forward", "backward")
    return Survey(tuple(Run(str(k), directions[k % 2], x, one) for k, one in enumerate(found)), "check.csv")  # type: ignore[arg-type]


def test_the_right_map_passes_whatever_the_uncertainty_of_the_check() -> None:
    for noise in (1e-9, 0.1e-6, 1e-6):
        agreed = [survey_check(SHIPPED, measured(SHIPPED, seed, noise=noise), NOISE).agrees for seed in range(40)]
        assert all(agreed)


@pytest.mark.parametrize("scale", [0.0, 0.5, 2.0, -1.0], ids=["straight", "half", "twice", "opposite"])
def test_a_map_of_another_guide_is_found(scale: float) -> None:
    for seed in range(20):
        found = survey_check(SHIPPED, measured(SHIPPED, seed, scale=scale), NOISE)
        assert not found.agrees and found.opposite is (scale < 0.0)
        assert found.difference > 3.0 * found.allowed


def test_a_map_with_another_zero_of_x_is_found() -> None:
    x = np.linspace(*SHIPPED.span, 200)
    shifted = Run("1", "forward", x + 0.1, SHIPPED.deviations(x))
    other = StraightnessMap(Survey((shifted,)), MapParameters())
    assert not survey_check(other, measured(SHIPPED, 1), NOISE).agrees


def test_a_check_that_is_too_coarse_to_tell_says_how_coarse_it_is() -> None:
    found = survey_check(SHIPPED, measured(SHIPPED, 1, noise=10e-6), NOISE)
    assert found.agrees and found.allowed > found.guide


def test_a_single_run_and_a_check_beside_the_map_are_refused() -> None:
    with pytest.raises(SurveyError, match=r"check survey check.csv: has one run; allowed: >= 2"):
        survey_check(SHIPPED, measured(SHIPPED, 1, runs=1), NOISE)
    far = measured(SHIPPED, 1)
    moved = Survey(tuple(Run(run.name, run.direction, run.x + 1.2, run.deviation) for run in far.runs), "check.csv")
    with pytest.raises(SurveyError, match=r"check survey check.csv: \d points between 0 mm and .*where the map is"):
        survey_check(SHIPPED, moved, NOISE)
