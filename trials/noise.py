"""Measure the error of a map by its survey's spacing and noise: through every mean, smoothed by `auto`, and by SciPy's
smoothing spline with the best λ for the known guide; on the shipped guide, with a joint in it, on 3 m with hysteresis
and on a ground guide."""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from itertools import product
from typing import NamedTuple

import numpy as np

from scripts.stage_files import STAGES
from straightcomp_ros.analysis.record import Array
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.survey import Run, Survey
from straightcomp_ros.straightness.survey_header import WAYS, Direction, SurveyError

SUMMARY = "error of the map by spacing and noise of the survey"
GUIDE = load_map(MapParameters("config/guide_synthetic.csv", smooth="none"))
FINE = np.linspace(*GUIDE.span, 17_601)
JOINT, KINK = 0.9, 5e-5
"""x in m of the joint, and the change of the guide's slope there in m/m: about the largest slope of the guide."""
_DRAWS = 9
"""Surveys of each kind."""
SPACINGS_MM, NOISES_UM = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0), (0.02, 0.05, 0.2, 0.5)
_TRAVEL = 5e-3
"""m, wide enough for the slopes that noise leaves at the ends."""


class Kind(NamedTuple):
    """A kind of guide: its straightness, the change of slope at its joint in m/m, and the largest value of its
    hysteresis in m."""

    base: StraightnessMap = GUIDE
    kink: float = 0.0
    hysteresis: float = 0.0

    def true(self, x: Array, way: Direction) -> Array:
        """δ in m of the guide at ``x`` in m on the way; its hysteresis is a wave of 1.5 m."""
        half = 0.5 if way == "forward" else -0.5
        return guide(x, self.kink, self.base) + half * self.hysteresis * np.sin(np.pi * x / 1.5) ** 2

    @property
    def fine(self) -> Array:
        """x in m in steps of 0.1 mm."""
        return np.linspace(*self.base.span, round(np.ptp(self.base.span) / 1e-4) + 1)


SHIPPED = Kind()


def _surveyed_guide(survey: str, hysteresis: float = 0.0) -> Kind:
    guide = load_map(MapParameters(str(STAGES / survey), smooth="none", direction="mean"))
    return Kind(guide, hysteresis=hysteresis)


def kinds() -> dict[str, Kind]:
    """By name."""
    return {
        "shipped": SHIPPED,
        "with a joint": Kind(kink=KINK),
        "3 m, hysteresis 0.3 um": _surveyed_guide("gantry_3_m.csv", 0.3e-6),
        "ground, 2 um": _surveyed_guide("ground_300_mm.csv"),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--noise", type=float, nargs="+", default=NOISES_UM, metavar="UM", help="default: %(default)s")


def run(options: argparse.Namespace) -> None:
    """Print the errors for each guide, spacing and noise."""
    rows = []
    for (name, kind), spacing, noise in product(kinds().items(), SPACINGS_MM, options.noise):
        row: dict[str, object] = {"guide": name, "spacing_mm": spacing, "noise_um": noise}
        with suppress(SurveyError):  # the short guide has too few points at 20 mm
            row |= errors(kind, spacing, noise)
        rows.append(row)
    print_json({"rows": rows})


def errors(kind: Kind, spacing_mm: float, noise_um: float) -> dict[str, float]:
    """Errors p-p in µm of the maps, medians over the surveys and both ways, by the map's name: through every mean,
    smoothed, and by the best spline for one who knows the guide, where there is hysteresis of the runs of each way."""
    found = defaultdict[str, list[float]](list)
    for seed in range(_DRAWS):
        survey = surveyed(spacing_mm * 1e-3, noise_um * 1e-6, kind, seed=seed)
        through, smoothed = mapped(survey, "none"), mapped(survey)
        for way in WAYS:
            true = kind.true(kind.fine, way)
            ours = [run.deviation for run in survey.runs if run.direction == way or not kind.hysteresis]
            best = best_spline(survey.runs[0].x, np.mean(ours, axis=0), kind.fine, true)
            maps = {
                "interpolated": through.deviations(kind.fine, way),
                "auto": smoothed.deviations(kind.fine, way),
                "best": best(kind.fine),
            }
            for name, deviations in maps.items():
                found[name].append(float(np.ptp(deviations - true)) * 1e6)
    return {name: float(np.median(pp)) for name, pp in found.items()}


def best_spline(x: Array, mean: Array, fine: Array, true: Array) -> Callable[[Array], Array]:
    """SciPy's smoothing spline, in m over m, with the λ of the least error p-p from the ``true`` guide at ``fine``."""
    from scipy.interpolate import make_smoothing_spline

    splines = [make_smoothing_spline(x * 1e3, mean * 1e6, lam=amount) for amount in np.geomspace(1e-2, 1e7, 19)]
    best = min(splines, key=lambda spline: float(np.ptp(spline(fine * 1e3) * 1e-6 - true)))  # λ of µm over mm
    return lambda at: np.asarray(best(at * 1e3) * 1e-6)


def guide(x: Array, kink: float = 0.0, base: StraightnessMap = GUIDE) -> Array:
    """δ of the shipped guide or of ``base`` in m, with a change of slope of ``kink`` in m/m at the joint."""
    return np.asarray(base.deviations(x) + 0.5 * kink * np.abs(x - JOINT))


def surveyed(
    spacing: float,
    noise: float,
    kind: Kind = SHIPPED,
    *,
    runs: int = 6,
    seed: int = 1,
    drift: float = 0.0,
) -> Survey:
    """Runs forward and backward in turn along a guide of this kind. ``drift``: of a run's offset in m and slope in m/m,
    one standard deviation."""
    span, ways = kind.base.span, [WAYS[i % 2] for i in range(runs)]
    x = np.linspace(*span, round(np.ptp(span) / spacing) + 1)
    random = np.random.default_rng(seed)
    lines = drift * random.normal(size=(runs, 2)) @ np.array([np.ones_like(x), x])
    values = np.array([kind.true(x, way) for way in ways]) + lines + random.normal(0.0, noise, (runs, x.size))
    return Survey(tuple(Run(str(i // 2 + 1), way, x, values[i]) for i, way in enumerate(ways)))


def mapped(survey: Survey, smooth: str = "auto") -> StraightnessMap:
    """The map of a survey."""
    return StraightnessMap(survey, MapParameters(smooth=smooth, travel=_TRAVEL))
