"""Fits the simulated plant's friction to the paper's figure for linear control, and shows what smc needs for its own.

Run `python scripts/fit_paper_plant.py`: a few minutes, the same numbers; docs/evidence/plant.md explains them.
Figures are true peak-to-peak errors in µm over the whole cycle: median of nine starts (min to max).
"""

import dataclasses
import math
from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.stats import qmc

from straightcomp_ros.analysis.record import motion_of
from straightcomp_ros.control import sliding_mode
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.margins import bisected, loop_margins
from straightcomp_ros.control.sliding_mode import SlidingDesign, reaching_bound
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.scenario import make_scenario
from straightcomp_ros.offline.starts import Spread, offsets, spread
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()
"""The shipped stage."""
LINEAR, SMC = 1.77, 0.40
"""The paper's figures in µm peak to peak."""
TOLERANCE = 0.15
STATIC_RATIO = 1.5
"""F_S/F_C of the fit, as in Canudas de Wit et al. (1995): one figure does not identify it."""
BOX = {
    "coulomb": (0.1, 3.0),  # N: 0.3 to 10 % of the platform's weight
    "static_ratio": (1.0, 2.0),  # F_S/F_C
    "stribeck_velocity": (10e-6, 0.1),  # m/s
    "break_away": (1e-6, 20e-6),  # m: (F_S + F_C)/σ0; beyond 20 µm it would not hold against the magnets
    "damping_ratio": (0.05, 1.0),  # σ1 / (2 √(σ0 M))
    "viscous": (0.1, 100.0),  # N·s/m
}
"""Usual ranges. v_s, break-away distance: Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994."""


class Stroke:
    """A stroke forward and back, on the shipped survey or on a guide of the same height shaped as a cosine.

    Args:
        half_waves: half waves of the cosine along the stroke; None takes the survey.

    Attributes:
        rate: largest |ṙ| in m/s.
    """

    def __init__(self, half_waves: int | None = None) -> None:
        self._scenario = make_scenario({}, ["linear"])
        stroke = self._scenario.stroke()
        self._true_r, reference = stroke.map.evaluate(stroke.true_x)[0], stroke.references
        if half_waves is not None:
            length = STAGE.motion.stroke
            wave = half_waves * math.pi / length
            height = 0.5 * float(np.ptp(stroke.map.evaluate(np.linspace(0.0, length, 20_000))[0]))
            r = height * np.cos(wave * stroke.x)
            self._true_r = height * np.cos(wave * stroke.true_x)
            reference = np.stack([r, np.gradient(r, STAGE.period), np.zeros_like(r)], axis=1)
        # The law gets the reference of the sample itself, without a lead.
        self._stroke = stroke._replace(given=reference)
        self._window = motion_of(stroke.stamps * 1e-9, stroke.x).window
        self.rate = float(np.abs(reference[self._window, 1]).max())

    def error(self, plant: PlantParameters, law: Law, *, delay: float = 0.5, start: float = 0.0) -> float:
        """True peak to peak error in µm, with commands ``delay`` samples late, and the platform at ``start`` in m."""
        true_y = self._scenario.cycle(law, self._stroke, delay, plant=plant, offset=start).true_y
        return float(np.ptp((self._true_r - true_y)[self._window])) * 1e6

    def errors(self, *arguments: Any, **options: Any) -> Spread:
        """:meth:`error` in µm over the starts."""
        return spread(self.error(*arguments, start=start, **options) for start in offsets())


def law(slope: float = 0.0, *, feedforward: bool = False, rho: float = 1.0, velocity_bandwidth: float = 1000.0) -> Law:
    """The paper's design; ``slope`` ρ/ε in 1/s of the boundary layer: 0 is linear control, inf is sgn σ."""
    gains = sliding_mode.gains(
        SlidingDesign(rho=rho, boundary_layer=rho / slope if slope else 1.0, velocity_bandwidth=velocity_bandwidth),
        STAGE,
        switching=slope > 0.0,
        feedforward=feedforward,
    )
    return Law(gains, sliding_mode.start, sliding_mode.step)


def plant_with(coulomb: float, **others: Any) -> PlantParameters:
    """The shipped plant with this Coulomb friction in N, F_S in proportion, and ``others`` by dotted name."""
    friction = {"friction.coulomb": coulomb, "friction.static": round(STATIC_RATIO * coulomb, 7)}
    return from_mapping(StageParameters, {**friction, **others}).plant


def plant_in_box(point: Iterable[float]) -> PlantParameters:
    """The plant at a point of the unit cube, each axis logarithmic over its range in BOX."""
    value = {name: low * (high / low) ** p for (name, (low, high)), p in zip(BOX.items(), point, strict=True)}
    static = value["coulomb"] * value["static_ratio"]
    stiffness = (static + value["coulomb"]) / value["break_away"]
    friction = {
        "coulomb": value["coulomb"],
        "static": static,
        "stribeck_velocity": value["stribeck_velocity"],
        "bristle_stiffness": stiffness,
        "bristle_damping": 2.0 * value["damping_ratio"] * math.sqrt(stiffness * STAGE.platform.mass),
        "viscous": value["viscous"],
    }
    return from_mapping(StageParameters, {f"friction.{name}": number for name, number in friction.items()}).plant


def print_heads(title: str, *heads: str) -> None:
    """Begin a table in Markdown, with its title."""
    print(f"\n## {title}\n\n| {' | '.join(heads)} |\n{'|---' * len(heads)}|")


def survey_the_box(stroke: Stroke, count: int = 512) -> None:
    """Which plants of the box give the paper's figure for linear control: what one figure says, and what not."""
    points = qmc.Sobol(len(BOX), seed=1).random(count).tolist()
    found = np.array([stroke.error(plant_in_box(point), law()) for point in points])
    fits = np.abs(found - LINEAR) <= TOLERANCE * LINEAR
    title = f"The box: {fits.sum()} of {count} plants give {LINEAR} µm within {TOLERANCE:.0%}"
    heads = ("range of the box", "5 to 95 % of those that fit", "rank correlation with the figure")
    print_heads(title, "parameter", *heads)
    ranks = np.argsort(np.argsort(found))
    for column, (name, (low, high)) in enumerate(BOX.items()):
        p5, p95 = (low * (high / low) ** p for p in np.percentile(np.array(points)[fits, column], (5, 95)))
        correlation = np.corrcoef(np.argsort(np.argsort(np.array(points)[:, column])), ranks)[0, 1]
        print(f"| {name} | {low:g} – {high:g} | {p5:.3g} – {p95:.3g} | {correlation:+.2f} |")


def fitted_coulomb(stroke: Stroke) -> float:
    """F_C in N, to 0.01 N, at which the shipped plant with F_S/F_C fixed gives the paper's figure."""
    levels = [0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0]
    title = "Linear control over Coulomb friction (F_S = 1.5 F_C, the rest as shipped)"
    print_heads(title, "F_C [N]", "linear (9)", "with feedforward")
    rows = []
    for level in levels:
        rows.append(stroke.errors(plant_with(level), law()))
        print(f"| {level:g} | {rows[-1].text(2)} | {stroke.errors(plant_with(level), law(feedforward=True)).text(2)} |")
    for (low, row), (high, next_row) in pairwise(zip(levels, rows, strict=True)):
        if row[0] <= LINEAR <= next_row[0]:
            return round(low + (high - low) * (LINEAR - row[0]) / (next_row[0] - row[0]), 2)
    raise SystemExit(f"no F_C of {levels} N gives {LINEAR} µm: medians {[round(row[0], 2) for row in rows]} µm")


def show_switching(stroke: Stroke, plant: PlantParameters, title: str, *, feedforward: bool) -> None:
    """Error over ρ and over the slope ρ/ε of the boundary layer."""
    slopes = [100.0, 250.0, 300.0, 350.0, 500.0, 700.0, 1000.0, math.inf]
    print_heads(f"{title}; paper: {SMC:.2f}", "ρ [m/s²]", *(f"ρ/ε = {slope:g} /s" for slope in slopes[:-1]), "sgn")
    for rho in (0.4, 0.7, 1.0, 2.0):
        cells = [stroke.errors(plant, law(slope, rho=rho, feedforward=feedforward)).text(2) for slope in slopes]
        print(f"| {rho:g} | " + " | ".join(cells) + " |")


def show_velocity_estimate(stroke: Stroke, plant: PlantParameters, slope: float) -> None:
    """Error over the bandwidth of the velocity estimate, with boundary layer and with sgn."""
    heads = ("linear", f"ρ = 1, ρ/ε = {slope:g} /s", "sgn, ρ = 0.4", "sgn, ρ = 1")
    print_heads("With feedforward, over the velocity estimate", "bandwidth [Hz]", *heads)
    for bandwidth in (50.0, 100.0, 200.0, 400.0, 1000.0):
        cases = [(0.0, 1.0), (slope, 1.0), (math.inf, 0.4), (math.inf, 1.0)]
        laws = [law(at, rho=rho, feedforward=True, velocity_bandwidth=bandwidth) for at, rho in cases]
        print(f"| {bandwidth:g} | " + " | ".join(stroke.errors(plant, chosen).text(2) for chosen in laws) + " |")


def show_drive(stroke: Stroke, coulomb: float, slope: float) -> None:
    """Error over command delay and amplifier bandwidth, and which slope is stable."""
    heads = ("linear", "smc, no feedforward", "smc, feedforward", "sgn, ρ = 0.4, feedforward", "stable below ρ/ε")
    print_heads("Delay and amplifier", "delay [samples]", "amplifier [Hz]", *heads)
    laws = [law(), law(slope), law(slope, feedforward=True), law(math.inf, rho=0.4, feedforward=True)]
    for delay in (0.0, 0.5, 1.0):
        for bandwidth in (200.0, 500.0, 2000.0):
            plant = plant_with(coulomb, **{"drive.bandwidth": bandwidth})
            cells = [stroke.errors(plant, chosen, delay=delay).text(2) for chosen in laws]
            limit = stable_slope(delay, bandwidth)
            print(f"| {delay:g} | {bandwidth:g} | " + " | ".join(cells) + f" | {limit:.0f} /s |")


def stable_slope(delay: float, bandwidth: float) -> float:
    """Slope ρ/ε in 1/s, to 10 /s, up to which the sampled loop inside the boundary layer is stable."""
    stage = from_mapping(StageParameters, {"drive.delay": delay, "drive.bandwidth": bandwidth})
    return bisected(lambda slope: bool(np.abs(loop_margins(law(slope), stage).poles).max() < 1.0), 0.0, 5000.0, 9)


def show_guides(slope: float) -> None:
    """The literal law, without feedforward, on guides of the survey's height but other slopes."""
    title = "Without feedforward, other guides of the same height (cosine of n half waves)"
    print_heads(title, "n", "largest ṙ [µm/s]", "lag alone, p-p [µm]", "F_C [N]", "linear", "smc")
    for half_waves in (2, 3, 4, 6):
        stroke = Stroke(half_waves)
        lag = 2.0 * SlidingDesign().zeta / SlidingDesign().omega_n * 2.0 * stroke.rate * 1e6
        for coulomb in (0.43, 1.0, 2.0, 4.0):
            plant = plant_with(coulomb)
            cells = [stroke.errors(plant, law(chosen)).text(2) for chosen in (0.0, slope)]
            print(f"| {half_waves} | {stroke.rate * 1e6:.0f} | {lag:.2f} | {coulomb:g} | {cells[0]} | {cells[1]} |")


def main() -> None:
    """Print all tables, in Markdown."""
    stroke, slope = Stroke(), 300.0
    still = plant_with(1e-6, **{"friction.viscous": 0.0, "encoder.y_resolution": 1e-12, "drive.dac_bits": 24})
    floor = stroke.error(still, law())
    print(f"largest ṙ {stroke.rate * 1e6:.1f} µm/s; without friction and quantisation the law without feedforward")
    print(f"leaves {floor:.3f} µm, with it {stroke.error(still, law(feedforward=True)):.4f} µm")
    survey_the_box(stroke)
    coulomb = fitted_coulomb(stroke)
    plant = plant_with(coulomb)
    stage = dataclasses.replace(STAGE, friction=plant.friction)
    print(f"\nfitted: F_C = {coulomb:g} N, F_S = {plant.friction.static:g} N;", end=" ")
    print(f"(11) asks for ρ > {reaching_bound(SlidingDesign(), stage):.3f} m/s²")
    for feedforward, words in ((False, "the paper's law, without feedforward"), (True, "with feedforward")):
        show_switching(stroke, plant, f"smc, {words}", feedforward=feedforward)
    show_velocity_estimate(stroke, plant, slope)
    show_drive(stroke, coulomb, slope)
    show_guides(slope)


if __name__ == "__main__":
    main()
