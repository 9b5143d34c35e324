"""Measure the error of a map by its survey's spacing and noise: through every mean, smoothed by `auto`, and by SciPy's
smoothing spline with the best λ for the known guide; on the shipped guide, with a joint in it, on 3 m with hysteresis
and on a ground guide; or the straightness that strokes by these maps leave."""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from scripts.stage_files import STAGES
from straightcomp_ros.analysis.metrics import straightness_over
from straightcomp_ros.analysis.record import Array
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.offline.scenario import laws_of, make_scenario
from straightcomp_ros.offline.starts import offsets
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.straightness.feedforward import along
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.survey import Run, Survey
from straightcomp_ros.straightness.survey_header import WAYS, Direction

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
    """A kind of guide: its straightness, the change of slope at its joint in m/m, the largest value of its hysteresis
    in m, and the file of a stage that has it, for residuals; empty for the shipped one."""

    base: StraightnessMap = GUIDE
    kink: float = 0.0
    hysteresis: float = 0.0
    stage: str = ""

    def true(self, x: Array, way: Direction) -> Array:
        """δ in m of the guide at ``x`` in m on the way; its hysteresis is a wave of 1.5 m."""
        half = 0.5 if way == "forward" else -0.5
        return guide(x, self.kink, self.base) + half * self.hysteresis * np.sin(np.pi * x / 1.5) ** 2

    @property
    def fine(self) -> Array:
        """x in m in steps of 0.1 mm."""
        return np.linspace(*self.base.span, round(np.ptp(self.base.span) / 1e-4) + 1)

    @property
    def direction(self) -> str:
        """Tables of a map of this guide, as parameter."""
        return "both" if self.hysteresis else "mean"


SHIPPED = Kind()


def _of_stage(stage: str, survey: str, hysteresis: float = 0.0) -> Kind:
    file = str(STAGES / survey)
    return Kind(load_map(MapParameters(file, smooth="none", direction="mean")), 0.0, hysteresis, str(STAGES / stage))


def kinds() -> dict[str, Kind]:
    """By name."""
    return {
        "shipped": SHIPPED,
        "with a joint": Kind(kink=KINK),
        "3 m, hysteresis 0.3 um": _of_stage("gantry.yaml", "gantry_3_m.csv", 0.3e-6),
        "ground, 2 um": _of_stage("short_ground.yaml", "ground_300_mm.csv"),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--noise", type=float, nargs="+", default=NOISES_UM, metavar="UM", help="default: %(default)s")
    add("--residuals", action="store_true", help="straightness by simulation, nine starts, in place of the map's error")


def run(options: argparse.Namespace) -> None:
    """Print for each guide, spacing and noise the median errors p-p in µm, or the residual straightness of strokes."""
    figures, rows = residuals if options.residuals else errors, []
    for (name, kind), spacing, noise in product(kinds().items(), SPACINGS_MM, options.noise):
        rows.append({"guide": name, "spacing_mm": spacing, "noise_um": noise, **figures(kind, spacing, noise)})
    print_json({"rows": rows})


def maps_of(
    kind: Kind, base: MapParameters, spacing_mm: float, noise_um: float, seed: int
) -> dict[str, tuple[Survey, MapParameters]]:
    """Survey and parameters of the maps by name: through every mean, smoothed, and by the best spline for one who knows
    the guide, where there is hysteresis of the runs of each way."""
    base, fine = replace(base, travel=_TRAVEL), kind.fine
    survey, runs = surveyed(spacing_mm * 1e-3, noise_um * 1e-6, kind, seed=seed), []
    for way in WAYS:
        ours = [run.deviation for run in survey.runs if run.direction == way or not kind.hysteresis]
        best = best_spline(survey.runs[0].x, np.mean(ours, axis=0), fine, kind.true(fine, way))
        runs.append(Run("1", way, fine[::10], best(fine[::10])))
    through = replace(base, smooth="none")
    return {
        "interpolated": (survey, through),
        "auto": (survey, base),
        "best": (Survey(tuple(runs)), replace(through, direction=kind.direction)),
    }


def errors(kind: Kind, spacing_mm: float, noise_um: float) -> dict[str, float]:
    """Medians over the surveys and both ways, by name."""
    found = defaultdict[str, list[float]](list)
    for seed in range(_DRAWS):
        for name, (survey, parameters) in maps_of(kind, MapParameters(), spacing_mm, noise_um, seed).items():
            straightness = StraightnessMap(survey, parameters)
            for way in WAYS:
                error = straightness.deviations(kind.fine, way) - kind.true(kind.fine, way)
                found[name].append(float(np.ptp(error)) * 1e6)
    return {name: float(np.median(pp)) for name, pp in found.items()}


def residuals(kind: Kind, spacing_mm: float, noise_um: float) -> dict[str, float]:
    """Residual straightness in µm of a cycle, the median over the surveys and nine starts, with these maps. The
    hysteresis of the true guide changes sides within a quarter of the travel that the reference takes for it."""
    values, law = by_node(shipped_parameters(stage=kind.stage or None)), "smc_observer"
    scenario, found = make_scenario(values, [law]), defaultdict[str, list[float]](list)
    base, points = scenario.followed.guide, kind.fine[::10]
    truth = Survey(tuple(Run("1", way, points, kind.true(points, way)) for way in WAYS))
    exact = replace(base, travel=_TRAVEL, smooth="none", direction=kind.direction, reversal=base.reversal / 4.0)
    true = StraightnessMap(truth, exact)
    for seed in range(_DRAWS):
        for name, (survey, parameters) in maps_of(kind, base, spacing_mm, noise_um, seed).items():
            one = replace(scenario, followed=replace(scenario.followed, guide=parameters), survey=survey)
            stroke = one.stroke()
            deviation = true.offset - along(true, stroke.true_x)[0]
            for offset in offsets():
                cycle = one.cycle(laws_of(one)[law], stroke, offset=offset)
                record = stroke.record(stroke.stamps * 1e-9, cycle, deviation, law)
                found[name].append(float(np.ptp(straightness_over(record, stroke.map)[2])) * 1e6)
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
