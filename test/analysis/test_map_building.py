"""Maps of runs: which runs and points are rejected, and what is taken out of the mean."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from surveys import one_run

from straightcomp_ros.analysis.map_building import FLOOR, Choices, build, disagreement
from straightcomp_ros.straightness.survey import Run, Survey, read_survey
from straightcomp_ros.tuning.survey.recording import spikes


def test_level_takes_the_slope_of_the_straight_edge_out():
    x = np.linspace(0.0, 0.4, 81)
    survey = one_run(x, 5e-6 * np.sin(2.0 * np.pi * x / 0.3) + 1e-5 * x + 1e-3)
    level, tilted = (build(survey, Path(__file__), Choices(10e-3, 6.0, way)) for way in (True, False))
    assert np.polyfit(level.straightness.report.x, level.straightness.report.mean, 1)[0] == pytest.approx(0.0, abs=1e-9)
    assert tilted.straightness.report.mean.mean() == pytest.approx(0.0, abs=1e-12)
    assert tilted.figures()["straightness_least_squares_um"] == pytest.approx(
        level.figures()["straightness_least_squares_um"]
    )


def noisy(count=5):
    return np.random.default_rng(3).normal(0.0, 3e-8, (count, 40))


@pytest.mark.parametrize(
    ("bad", "rejected"),
    [
        ([10], False),
        ([10, 11, 12], False),
        ([10, 11, 12, 13], True),
        ([3, 4, 5, 8, 9, 10], False),  # two stretches of three are no stretch of six
        (range(2, 32, 3), False),  # a quarter of all, none of them neighbours
        (range(2, 35, 3), True),
    ],
)
def test_single_points_are_rejected_up_to_three_neighbours_and_a_quarter_and_then_the_run(bad, rejected):
    values = noisy()
    values[2, list(bad)] -= 3e-6
    found = disagreement(values, 6.0)
    assert found[0].tolist() == [False, False, rejected, False, False]
    assert np.argwhere(found[1]).tolist() == ([] if rejected else [[2, at] for at in bad])


def test_the_worst_run_goes_first_and_the_others_are_judged_anew_while_there_are_three():
    values = noisy(7)
    values[3] += 9e-6
    values[5] += 3e-6
    assert np.flatnonzero(disagreement(values, 6.0)[0]).tolist() == [3, 5]
    values = noisy(3)
    values[1, 10:22] += 3e-6
    assert disagreement(values, 6.0)[0].tolist() == [False, True, False]
    found = disagreement(values[:2], 6.0)
    assert not found[0].any() and not found[1].any()


@pytest.mark.parametrize(
    ("step", "count", "first", "spikes"),
    [
        (0.02, 20, 0, [10]),
        (0.04, 30, 0, [10]),
        (0.04, 30, 0, [28, 29]),
        # Where it begins itself the next point is near enough, but not where the others begin.
        (0.03, 30, 1, [1]),
    ],
)
def test_a_run_of_which_rejected_points_leave_too_little_is_rejected_so_that_the_map_can_be_read(
    tmp_path, step, count, first, spikes
):
    x = step * np.arange(count)
    values = 1e-5 * np.sin(8.0 * x) + np.random.default_rng(3).normal(0.0, 3e-8, (10, count))
    values[2, spikes] += 3e-6
    runs = [Run(str(n // 2), ("forward", "backward")[n % 2], x, one) for n, one in enumerate(values)]
    runs[2] = replace(runs[2], x=x[first:], deviation=values[2, first:])
    built = build(Survey(tuple(runs)), Path(__file__), Choices(10e-3, 6.0))
    assert (built.rejected_runs, built.rejected_points) == (["1 forward"], [])
    built.write(tmp_path / "map.csv")
    assert len(read_survey(tmp_path / "map.csv").runs) == 9


def test_below_the_floor_nothing_is_an_outlier_and_runs_that_agree_are_kept_whole():
    residual = np.zeros(100)
    residual[[5, 6]] = 0.99 * FLOOR, 1.01 * FLOOR
    assert np.flatnonzero(spikes(residual, 6.0)).tolist() == [6]
    guide = 1e-5 * np.sin(np.linspace(0.0, 6.0, 40))
    for count in (3, 4, 7):
        found = disagreement(guide + noisy(count), 6.0)
        assert not found[0].any() and not found[1].any()
    values = guide + noisy(4) / 60.0
    values[1, [5, 6]] += (0.9 * FLOOR, 1.1 * FLOOR)
    assert np.argwhere(disagreement(values, 6.0)[1]).tolist() == [[1, 6]]


def test_a_map_names_the_contents_of_its_file_or_of_all_files_of_its_bag_in_order(tmp_path):
    whole = bytes(range(256)) * 5000
    (tmp_path / "survey.csv").write_bytes(whole)
    bag = tmp_path / "bag"
    bag.mkdir()
    for name, part in (("b.mcap", whole[700_000:]), ("a.mcap", whole[:700_000]), ("metadata.yaml", b"other")):
        (bag / name).write_bytes(part)
    x = np.linspace(0.0, 0.4, 81)
    survey = one_run(x, 5e-6 * np.sin(2.0 * np.pi * x / 0.3))
    for source in (tmp_path / "survey.csv", bag):
        built = build(survey, source, Choices(10e-3, 6.0))
        assert built.provenance["source"] == f"{source.name}, sha256 {hashlib.sha256(whole).hexdigest()[:16]}"
        assert "step 10 mm" in built.provenance["choices"]
        assert built.provenance["runs"] == "1 forward, 0 backward; rejected runs: none; rejected points: 0"
    shown = built.figures()
    assert (shown["first_mm"], shown["last_mm"], shown["points"]) == (0.0, 400.0, 81)
    assert shown["correction_pp_um"] == pytest.approx(np.ptp(5.0 * np.sin(2.0 * np.pi * x / 0.3)), rel=1e-3)
    assert (shown["rejected_runs"], shown["partial_runs"], shown["samples"]) == (0, 0, 0)
