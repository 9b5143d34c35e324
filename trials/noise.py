"""Measure the error of a map by its survey's spacing and noise: through every mean, smoothed by `auto`, and by SciPy's
smoothing spline with the best λ for the known guide; on the shipped guide, and with a joint in it."""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.cli.options import check_range
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.smoothing import NORMAL_95
from straightcomp_ros.straightness.survey import Direction, Run, Survey
from straightcomp_ros.straightness.survey_runs import on_common_grid

SUMMARY = "error of the map by spacing and noise of the survey"
GUIDE = load_map(MapParameters("config/guide_synthetic.csv", smooth="none"))
FINE = np.linspace(*GUIDE.span, 17_601)
JOINT, KINK = 0.9, 5e-5
"""x in m of the joint, and the change of the guide's slope there in m/m: about the largest slope of the guide."""
SPACINGS_MM, NOISES_UM = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0), (0.025, 0.05, 0.2, 0.5)
Array = NDArray[np.float64]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--draws", type=int, default=9, metavar="N", help="surveys of each kind (default: %(default)s)")


def run(options: argparse.Namespace) -> None:
    """Print for each guide, spacing and noise the median errors p-p in µm, and the coverage of the 95 % band."""
    check_range("--draws", options.draws, 1)
    print_json(
        {
            "rows": [
                {"kink": kink, "spacing_mm": spacing, "noise_um": noise, **errors(kink, spacing, noise, options.draws)}
                for kink in (0.0, KINK)
                for spacing in SPACINGS_MM
                for noise in NOISES_UM
            ]
        }
    )


def errors(kink: float, spacing_mm: float, noise_um: float, draws: int) -> dict[str, float]:
    """Medians over ``draws`` surveys, by name; the coverage is at the survey's own points."""
    true, rows = guide(FINE, kink), []
    for seed in range(draws):
        survey = surveyed(spacing_mm * 1e-3, noise_um * 1e-6, seed=seed, kink=kink)
        through, smoothed = (mapped(survey, how) for how in ("none", "auto"))
        x, values = on_common_grid(survey, 20, 0.05)
        left = smoothed.deviations(x) - guide(x, kink)
        rows.append(
            {
                "interpolated": float(np.ptp(through.deviations(FINE) - true)) * 1e6,
                "auto": float(np.ptp(smoothed.deviations(FINE) - true)) * 1e6,
                "best": best_possible(x, values.mean(axis=0), true) * 1e6,
                "coverage": float(np.mean(np.abs(left) <= NORMAL_95 * smoothed.noise.band(x))),
            }
        )
    mean = float(np.mean([row.pop("coverage") for row in rows]))
    return {name: float(np.median([row[name] for row in rows])) for name in rows[0]} | {"coverage": mean}


def best_possible(x: Array, mean: Array, true: Array) -> float:
    """Least error p-p in m over all λ of SciPy's smoothing spline."""
    from scipy.interpolate import make_smoothing_spline

    found = []
    for amount in np.geomspace(1e-2, 1e7, 19):  # of µm over mm
        spline = make_smoothing_spline(x * 1e3, mean * 1e6, lam=amount)
        found.append(float(np.ptp(spline(FINE * 1e3) * 1e-6 - true)))
    return min(found)


def guide(x: Array, kink: float = 0.0) -> Array:
    """δ of the shipped guide in m, with a change of slope of ``kink`` in m/m at the joint."""
    return np.asarray(GUIDE.deviations(x) + 0.5 * kink * np.abs(x - JOINT))


def settling(x: Array) -> Array:
    """Hysteresis of a guide over x in m as a share of its largest value."""
    return np.asarray(np.sin(np.pi * x / 1.5) ** 2)


def surveyed(
    spacing: float,
    noise: float,
    *,
    runs: int = 6,
    seed: int = 1,
    kink: float = 0.0,
    drift: float = 0.0,
    hysteresis: float = 0.0,
) -> Survey:
    """Runs forward and backward in turn. ``drift``: of a run's offset in m and slope in m/m, one standard deviation;
    ``hysteresis``: its largest value in m, over x a wave of 1.5 m."""
    x = np.linspace(*GUIDE.span, round(1.76 / spacing) + 1)
    random = np.random.default_rng(seed)
    ways: tuple[Direction, ...] = ("forward", "backward")
    lines = drift * random.normal(size=(runs, 2)) @ np.array([np.ones_like(x), x])
    half = 0.5 * np.array([hysteresis, -hysteresis])[np.arange(runs) % 2, None] * settling(x)
    values = guide(x, kink) + half + lines + random.normal(0.0, noise, (runs, x.size))
    return Survey(tuple(Run(str(i // 2 + 1), ways[i % 2], x, values[i]) for i in range(runs)))


def mapped(survey: Survey, smooth: str = "auto") -> StraightnessMap:
    """The map, whose travel is wide enough for the slopes that noise leaves at the ends."""
    return StraightnessMap(survey, MapParameters(smooth=smooth, travel=5e-3))
