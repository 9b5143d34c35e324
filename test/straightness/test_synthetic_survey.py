"""The synthetic guide: what it claims to be, and made again to the byte."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.residual import least_squares_residual, peak_to_peak
from straightcomp_ros.straightness.survey import read_survey

TOP = Path(__file__).resolve().parents[2]
CONFIG = TOP / "config"


@pytest.fixture(scope="module")
def guide() -> StraightnessMap:
    return load_map(MapParameters(file=str(CONFIG / "guide_synthetic.csv")))


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_synthetic_survey", TOP / "scripts/make_synthetic_survey.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["survey_synthetic.csv", "guide_synthetic.csv"])
def test_the_script_makes_the_same_bytes_again(script: ModuleType, tmp_path: Path, name: str) -> None:
    script.make(tmp_path)
    assert (tmp_path / name).read_bytes() == (CONFIG / name).read_bytes()


@pytest.mark.parametrize("name", ["survey_synthetic.csv", "guide_synthetic.csv"])
def test_the_files_say_that_they_are_synthetic(name: str) -> None:
    assert (CONFIG / name).read_text("utf-8").startswith("# Synthetic, not measured: made by scripts/make_synthetic")


def test_the_guide_is_22_4_micrometres_peak_to_peak_over_1760_mm() -> None:
    run = read_survey(CONFIG / "guide_synthetic.csv").runs[0]
    assert (run.x[0], run.x[-1]) == (0.0, 1.76)
    assert peak_to_peak(run.deviation) == pytest.approx(22.4e-6, abs=1e-12)
    assert peak_to_peak(least_squares_residual(run.x, run.deviation)) == pytest.approx(22.4e-6, abs=1e-9)


def test_the_guide_is_as_straight_by_length_as_by_points(guide: StraightnessMap) -> None:
    x = np.linspace(0.0, 1.76, 17_601)
    assert peak_to_peak(least_squares_residual(x, guide.deviations(x))) == pytest.approx(22.4e-6, abs=2e-9)


def test_the_guide_is_as_steep_as_the_papers(guide: StraightnessMap) -> None:
    slope_um_per_mm = np.abs(guide.evaluate(np.linspace(0.0, 1.76, 17_601))[1]) * 1e3
    assert 0.115 < slope_um_per_mm.max() < 0.125
    assert 0.04 < np.median(slope_um_per_mm) < np.percentile(slope_um_per_mm, 90) < 0.09


def test_the_survey_is_six_runs_that_repeat_within_a_tenth_of_a_micrometre(guide: StraightnessMap) -> None:
    straightness = load_map(MapParameters(file=str(CONFIG / "survey_synthetic.csv")))
    report = straightness.report
    forward, backward = report.forward, report.backward
    assert forward is not None and backward is not None
    assert (len(report.x), forward.runs, backward.runs) == (177, 3, 3)
    s = np.concatenate([forward.s, backward.s])
    assert s.max() < 0.1e-6
    assert np.sqrt(np.mean(s**2)) == pytest.approx(0.025e-6, rel=0.1)
    # 177 differences of two means of three: the largest of them lies below four standard deviations.
    assert np.abs(report.reversal).max() < 4.0 * 0.025e-6 * np.sqrt(2.0 / 3.0)
