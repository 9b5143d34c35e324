"""Fig. 5: release from 0.2 y0: the surface is reached, then the motion is that of (12)."""

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from straightcomp_ros.analysis.pictures import BLACK, BLUE, GREY, PALE_VERMILION, VERMILION
from straightcomp_ros.control.sliding_mode import SlidingDesign
from straightcomp_ros.tuning.paper.claims import Claim
from straightcomp_ros.tuning.paper.drawing import SMALL, label, mosaic
from straightcomp_ros.tuning.paper.ideal_machine import Machine
from straightcomp_ros.tuning.paper.release import Response, hold_still, release
from straightcomp_ros.tuning.paper.surface import (
    free_motion,
    gain_implied,
    rate_implied,
    reaching_demand,
    reaching_time,
    sliding_variable_at_rest,
    sliding_variable_over,
)

TITLE = "Fig. 5: release from 0.2 $y_0$ under sliding-mode control"
RELEASED_AT = 0.2
"""y/y0."""
PAPER_REACHING_TIME = 0.26
"""s."""
FITTING_GAINS = (0.01, 0.1)
"""ρ in m/s² for which the implied φ is stated."""
_DURATION = 0.08


@dataclass(frozen=True, eq=False)
class NearRelease:
    """The release, and its closed forms.

    Attributes:
        response: what the simulated loop did.
        design: the design of its law.
        sigma_0: σ at the release, m/s.
        reached: index of the first sample on or beyond the surface.
        closed_sigma: σ of the nominal plant at the same times, (n,) in m/s.
        closed_y: y by (12) from the sample ``reached`` on, in m.
    """

    response: Response
    design: SlidingDesign
    sigma_0: float
    reached: int
    closed_sigma: NDArray[np.float64]
    closed_y: NDArray[np.float64]
    claims: tuple[Claim, ...]


def compute(machine: Machine) -> NearRelease:
    """Release the idealised machine, and compare with the closed forms.

    The simulated plant has what the closed form of σ leaves out: the magnets' m_i and m_y, and friction.
    On the surface (12) holds with them.
    """
    ideal = machine.idealised().with_law("smc")
    design = ideal.control.smc
    response = release(ideal, RELEASED_AT * machine.plant.actuator.air_gap, hold_still(ideal, _DURATION))
    sigma_0 = sliding_variable_at_rest(design, float(response.y[0]))
    reached = int(np.argmax(response.sigma <= 0.0))
    sliding = slice(reached, None)
    closed_y = free_motion(
        response.time[sliding] - response.time[reached],
        design,
        float(response.y[reached]),
        float(response.velocity[reached]),
    )
    deviation = float(np.abs(response.y[sliding] - closed_y).max())
    demand = reaching_demand(design, ideal.stage, float(response.y[0]), float(response.command[0]))
    claims = _reaching_claims(design, sigma_0, float(response.time[reached]), demand)
    on_surface = Claim(
        "Fig. 5b: largest deviation from (12) on the surface",
        0.0,
        deviation * 1e6,
        "µm",
        tolerance=1.0,
        note=f"of a motion that enters the surface at {response.y[reached] * 1e6:.0f} µm",
    )
    closed_sigma = sliding_variable_over(response.time, design.phi, design.rho, sigma_0)
    return NearRelease(response, design, sigma_0, reached, closed_sigma, closed_y, (*claims, on_surface))


def _reaching_claims(design: SlidingDesign, sigma_0: float, simulated: float, demand: float) -> list[Claim]:
    paper, phi, rho = PAPER_REACHING_TIME, design.phi, design.rho
    latest = reaching_time(0.0, rho, sigma_0)
    at_most = f"with ρ = {rho:g} m/s² no φ fits: the latest, at φ = 0, is {latest:.3f} s"
    return [
        Claim(
            f"Fig. 5a: reaching time, closed form, φ = {phi:g} 1/s, ρ = {rho:g} m/s²",
            paper,
            reaching_time(phi, rho, sigma_0),
            "s",
            tolerance=0.1 * paper,
            note=f"{at_most}; the paper prints neither ρ nor y0",
        ),
        Claim(
            "Fig. 5a: reaching time, simulated",
            paper,
            simulated,
            "s",
            tolerance=0.1 * paper,
            note="magnets by (2), friction, sgn σ, no limit of the current",
        ),
        *(
            Claim(
                f"Fig. 5a: φ that {paper:g} s implies with ρ = {gain:g} m/s²",
                100.0,
                rate_implied(paper, gain, sigma_0),
                "1/s",
                tolerance=10.0,
                note=f"φ = 100 1/s would need ρ = {gain_implied(paper, 100.0, sigma_0):.1e} m/s²",
            )
            for gain in FITTING_GAINS
        ),
        Claim(
            "Fig. 5a: largest ρ with which any φ gives the paper's time",
            None,
            abs(sigma_0) / paper,
            "m/s²",
            note=f"here (11) asks for ρ > {demand:.2g} m/s² at the release: with that, {paper:g} s is far off",
        ),
    ]


def draw(data: NearRelease) -> Figure:
    """σ and y of the release beside their closed forms; below, what the paper's time says of φ and ρ."""
    figure, (sigma, position, times) = mosaic(TITLE, "ab;cc", size=(9.0, 7.5))
    _draw_release(sigma, position, data)
    _draw_reaching_times(times, data)
    return figure


def _draw_release(sigma: Axes, position: Axes, data: NearRelease) -> None:
    response = data.response
    time_ms = response.time * 1e3
    reached_ms = float(time_ms[data.reached])
    sigma.plot(time_ms, response.sigma * 1e3, color=BLUE, label="simulated")
    sigma.plot(time_ms, data.closed_sigma * 1e3, color=VERMILION, linestyle="--", label="closed form")
    position.plot(time_ms, response.y * 1e6, color=BLUE, linewidth=2.2, label="simulated")
    position.plot(
        time_ms[data.reached :], data.closed_y * 1e6, color=VERMILION, linestyle="--", label="(12) from the surface on"
    )
    for axes in (sigma, position):
        axes.axvline(reached_ms, color=GREY, linewidth=1.0, label=f"surface reached: {reached_ms:.1f} ms")
    label(sigma, "a: sliding variable", "time / ms", "sliding variable σ / (mm/s)")
    label(position, "b: position", "time / ms", "position y / µm")
    for axes in (sigma, position):
        axes.legend(loc="upper right", fontsize=SMALL)


def _draw_reaching_times(axes: Axes, data: NearRelease) -> None:
    rates = np.geomspace(1.0, 200.0, 200)
    gains = ((*FITTING_GAINS, data.design.rho), (BLACK, BLUE, VERMILION), ("-", "--", "-."))
    for gain, colour, style in zip(*gains, strict=True):
        times = [reaching_time(phi, gain, data.sigma_0) for phi in rates]
        axes.plot(rates, times, color=colour, linestyle=style, label=f"ρ = {gain:g} m/s²")
        implied = rate_implied(PAPER_REACHING_TIME, gain, data.sigma_0)
        if math.isfinite(implied):
            axes.plot(implied, PAPER_REACHING_TIME, "o", color=colour)
    axes.axhline(PAPER_REACHING_TIME, color=GREY, label=f"paper: {PAPER_REACHING_TIME} s")
    axes.axvspan(10.0, 20.0, color=PALE_VERMILION, alpha=0.5, linewidth=0.0, label="φ = 10 to 20 1/s")
    axes.plot(data.design.phi, data.response.time[data.reached], "s", color=VERMILION, label="simulated", markersize=6)
    axes.set_xscale("log")
    axes.set_yscale("log")
    title = "Reaching time (1/φ) ln(1 + φ|$σ_0$|/ρ): the φ and ρ that the paper's time implies"
    label(axes, title, "rate φ / (1/s)", "reaching time / s")
    axes.set_ylim(bottom=0.006)
    axes.legend(loc="lower left", fontsize=SMALL, ncols=2)
