"""The sliding motion: the poles of its design, closed forms of σ and of (12), and Fig. 5, release from 0.2 y0."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from straightcomp_ros.analysis.pictures import label
from straightcomp_ros.analysis.style import BLUE, GREY, VERMILION
from straightcomp_ros.control.sliding_mode import SlidingDesign, closed_loop_poles
from straightcomp_ros.tuning.paper.figure import SMALL, Claim, PaperFigure, sheet
from straightcomp_ros.tuning.paper.machine import Machine, release

NEAR = 0.2
"""y/y0 of the release."""
PAPER_POLES = (-175.9, 131.9, -100.0)
"""Real and imaginary part of the pair, and the real pole, rad/s."""
PAPER_REACHING_TIME = 0.26
"""s."""
FITTING_GAINS = (0.01, 0.1)
"""ρ in m/s² for which the implied φ is stated."""
_DURATION = 0.08


def pole_claims(machine: Machine) -> list[Claim]:
    """Poles of the nominal plant under (9) without its switching term."""
    poles = closed_loop_poles(machine.control.smc, machine.stage)
    pair = poles[np.argmax(poles.imag)]
    single = poles[np.argmin(np.abs(poles.imag))]
    names = ("closed-loop pole pair, real part", "closed-loop pole pair, imaginary part", "third closed-loop pole")
    note = "eigenvalues of A − B K; K from the design, M and the magnets cancel"
    found = zip(names, (pair.real, pair.imag, single.real), PAPER_POLES, strict=True)
    return [Claim(name, float(ours), "rad/s", note, paper, tolerance=0.1) for name, ours, paper in found]


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


def near_release(machine: Machine) -> PaperFigure:
    """Fig. 5: σ and y of the release of the idealised machine under (9), with their closed forms.

    The simulated plant has what the closed form of σ leaves out: the magnets' m_i and m_y, and friction. On the surface
    (12) holds with them.
    """
    design, ideal = machine.control.smc, machine.idealised().with_law("smc")
    response = release(ideal, NEAR * machine.gap, np.zeros(ideal.samples(_DURATION)))
    # The first sample on or beyond the surface; before, σ by (8) at rest with nothing integrated.
    reached, sigma_0 = int(np.argmax(response.sigma <= 0.0)), 2.0 * design.zeta * design.omega_n * float(response.y[0])
    time = response.time - response.time[reached]
    closed_y = free_motion(time[reached:], design, float(response.y[reached]), float(response.velocity[reached]))

    title = "Fig. 5: release from 0.2 $y_0$ under sliding-mode control"
    figure, (sigma, position) = sheet(title, "ab", size=(9.0, 4.0))
    time_ms, dashed = response.time * 1e3, {"color": VERMILION, "linestyle": "--"}
    closed_sigma = sliding_variable_over(response.time, design.phi, design.rho, sigma_0)
    sigma.plot(time_ms, response.sigma * 1e3, color=BLUE, label="simulated")
    sigma.plot(time_ms, closed_sigma * 1e3, label="closed form", **dashed)
    position.plot(time_ms, response.y * 1e6, color=BLUE, linewidth=2.2, label="simulated")
    position.plot(time_ms[reached:], closed_y * 1e6, label="(12) from the surface on", **dashed)
    for axes in (sigma, position):
        axes.axvline(time_ms[reached], color=GREY, linewidth=1.0, label=f"surface reached: {time_ms[reached]:.1f} ms")
    label(sigma, "a: sliding variable", "time / ms", "sliding variable σ / (mm/s)")
    label(position, "b: position", "time / ms", "position y / µm")
    for axes in (sigma, position):
        axes.legend(loc="upper right", fontsize=SMALL)
    simulated = float(response.time[reached])

    phi, rho, paper, tenth = design.phi, design.rho, PAPER_REACHING_TIME, 0.1 * PAPER_REACHING_TIME
    latest = f"with ρ = {rho:g} m/s² no φ fits: the latest, at φ = 0, is {reaching_time(0.0, rho, sigma_0):.3f} s"
    printed = "the paper's φ is 100 1/s"
    deviation = float(np.abs(response.y[reached:] - closed_y).max()) * 1e6
    unprinted = f"{latest}; the paper prints neither ρ nor y0"
    name = f"Fig. 5a: reaching time, closed form, φ = {phi:g} 1/s, ρ = {rho:g} m/s²"
    release_of = "magnets by (2), friction, sgn σ, no limit of the current"
    claims = [
        Claim(name, reaching_time(phi, rho, sigma_0), "s", unprinted, paper, tenth),
        Claim("Fig. 5a: reaching time, simulated", simulated, "s", release_of, paper, tenth),
    ]
    for gain in FITTING_GAINS:
        name = f"Fig. 5a: φ that {paper:g} s implies with ρ = {gain:g} m/s²"
        claims.append(Claim(name, rate_implied(paper, gain, sigma_0), "1/s", printed, 100.0, tolerance=10.0))
    surface = f"of a motion that enters the surface at {response.y[reached] * 1e6:.0f} µm"
    name = "Fig. 5b: largest deviation from (12) on the surface"
    claims.append(Claim(name, deviation, "µm", surface, 0.0, tolerance=1.0))
    return PaperFigure(claims, figure)
