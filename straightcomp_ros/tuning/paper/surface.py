"""The sliding motion: the poles of its design, closed forms of σ and of (12), and Fig. 5, release from 0.2 y0."""

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import brentq

from straightcomp_ros.analysis.pictures import BLACK, BLUE, GREY, PALE_VERMILION, VERMILION
from straightcomp_ros.control.sliding_mode import SlidingDesign, closed_loop_poles
from straightcomp_ros.model.actuator import stiffness_errors
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.paper.figure import SMALL, Claim, label, mosaic
from straightcomp_ros.tuning.paper.machine import Machine, Response, hold_still, release

NEAR = 0.2
"""y/y0 of the release."""
PAPER_POLES = (-175.9, 131.9, -100.0)
"""Real and imaginary part of the pair, and the real pole, rad/s."""
PAPER_REACHING_TIME = 0.26
"""s."""
FITTING_GAINS = (0.01, 0.1)
"""ρ in m/s² for which the implied φ is stated."""
_DURATION = 0.08


def pole_claims(machine: Machine) -> tuple[Claim, ...]:
    """Poles of the nominal plant under (9) without its switching term."""
    poles = closed_loop_poles(machine.control.smc, machine.stage)
    pair = poles[np.argmax(poles.imag)]
    single = poles[np.argmin(np.abs(poles.imag))]
    names = ("closed-loop pole pair, real part", "closed-loop pole pair, imaginary part", "third closed-loop pole")
    ours = (pair.real, pair.imag, single.real)
    note = "eigenvalues of A − B K; K from the design, M and the magnets cancel"
    return tuple(
        Claim(name, paper, float(value), "rad/s", tolerance=0.1, note=note)
        for name, paper, value in zip(names, PAPER_POLES, ours, strict=True)
    )


def sliding_variable_at_rest(design: SlidingDesign, y: float) -> float:
    """σ in m/s by (8) at rest at ``y`` in m with nothing integrated: 2ζωn y."""
    return 2.0 * design.zeta * design.omega_n * y


def reaching_time(phi: float, rho: float, sigma_0: float) -> float:
    """Time in s until σ = 0 from σ0 in m/s, where σ̇ = −φσ − ρ sgn σ: (1/φ) ln(1 + φ|σ0|/ρ).

    φ = 0 gives its limit |σ0|/ρ. The law (9) gives this σ̇ on the nominal plant.
    """
    if phi == 0.0:
        return abs(sigma_0) / rho
    return math.log1p(phi * abs(sigma_0) / rho) / phi


def sliding_variable_over(time: NDArray[np.float64], phi: float, rho: float, sigma_0: float) -> NDArray[np.float64]:
    """σ(t) in m/s on the nominal plant, for σ0 > 0: decays until the reaching time, zero from then on."""
    level = rho / phi
    return np.maximum((sigma_0 + level) * np.exp(-phi * time) - level, 0.0)


def rate_implied(time: float, rho: float, sigma_0: float) -> float:
    """φ in 1/s for which the surface is reached after ``time`` in s; NaN if none reaches it as late.

    The larger φ, the sooner; the latest is |σ0|/ρ, at φ = 0.
    """
    if reaching_time(0.0, rho, sigma_0) < time:
        return math.nan
    return float(brentq(lambda phi: reaching_time(phi, rho, sigma_0) - time, 0.0, 1e4))


def gain_implied(time: float, phi: float, sigma_0: float) -> float:
    """ρ in m/s² for which the surface is reached after ``time`` in s at the rate ``phi``."""
    return phi * abs(sigma_0) / math.expm1(phi * time)


def reaching_demand(design: SlidingDesign, stage: StageParameters, y: float, current: float) -> float:
    """ρ in m/s² that (11) demands at rest at ``y`` with r = 0 and nothing integrated, for the current i_c in A.

    There SAx + SB_r r = (ωn² + K̄_y/M) y, and SBη is the stiffness error and friction over mass. Infinite
    where |m_i| >= 1.
    """
    actuator, mass = stage.actuator, stage.platform.mass
    m_y, m_i = stiffness_errors(y / actuator.air_gap, current / actuator.bias_current)
    if abs(m_i) >= 1.0:
        return math.inf
    stiffness = actuator.position_stiffness / mass
    motion = (design.omega_n**2 + stiffness) * abs(y)
    disturbance = m_y * stiffness * abs(y) + stage.friction.static / mass
    return (abs(m_i) * motion + disturbance + design.gamma) / (1.0 - abs(m_i))


def free_motion(time: NDArray[np.float64], design: SlidingDesign, y_0: float, velocity_0: float) -> NDArray[np.float64]:
    """y(t) in m by (12) with r = 0, ζ < 1, from ``y_0`` in m and ``velocity_0`` in m/s at time zero."""
    decay = design.zeta * design.omega_n
    damped = design.omega_n * math.sqrt(1.0 - design.zeta**2)
    sine = (velocity_0 + decay * y_0) / damped
    return np.exp(-decay * time) * (y_0 * np.cos(damped * time) + sine * np.sin(damped * time))


def following_error_gain(design: SlidingDesign, omega: float) -> float:
    """|e/r| by (12) for a reference of ``omega`` in rad/s: |s² + 2ζωn s| / |s² + 2ζωn s + ωn²| at s = jω.

    For slow references this is ω · 2ζ/ωn: the reference is followed with a lag of 2ζ/ωn.
    """
    s = 1j * omega
    moving = s * s + 2.0 * design.zeta * design.omega_n * s
    return abs(moving / (moving + design.omega_n**2))


def lag(design: SlidingDesign) -> float:
    """2ζ/ωn in s: by so much the law follows a slow reference late, by (12)."""
    return 2.0 * design.zeta / design.omega_n


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

    def draw(self) -> Figure:
        """σ and y of the release with their closed forms; below, what the paper's time says of φ and ρ."""
        title = "Fig. 5: release from 0.2 $y_0$ under sliding-mode control"
        figure, (sigma, position, times) = mosaic(title, "ab;cc", size=(9.0, 7.5))
        _draw_release(sigma, position, self)
        _draw_reaching_times(times, self)
        return figure


def near_release(machine: Machine) -> NearRelease:
    """Release the idealised machine, and compare with the closed forms.

    The simulated plant has what the closed form of σ leaves out: the magnets' m_i and m_y, and friction.
    On the surface (12) holds with them.
    """
    ideal = machine.idealised().with_law("smc")
    design = ideal.control.smc
    response = release(ideal, NEAR * machine.plant.actuator.air_gap, hold_still(ideal, _DURATION))
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
