"""Fig. 7: friction against velocity, estimated from recorded signals."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from straightcomp_ros.analysis.pictures import BLUE, GREY, VERMILION
from straightcomp_ros.tuning.paper.claims import Claim
from straightcomp_ros.tuning.paper.drawing import SMALL, label, sheet
from straightcomp_ros.tuning.paper.friction_estimate import WINDOW, FrictionEstimate, estimate_friction
from straightcomp_ros.tuning.paper.ideal_machine import Machine
from straightcomp_ros.tuning.paper.release import Response
from straightcomp_ros.tuning.paper.sine import evaluated, follow_sine

TITLE = "Fig. 7: friction against velocity"
SLIDING = 150e-6
"""Speed in m/s from which the platform slides in earnest: there friction is Coulomb's."""


@dataclass(frozen=True, eq=False)
class FrictionCurve:
    """Estimate and truth in the periods evaluated; each array (n,).

    Attributes:
        time: s.
        estimate: from encoder and coil current.
        velocity, friction: the truth, m/s and N.
        rising: whether the reference accelerates toward positive velocities.
        width: largest distance of the two branches along F at equal velocity, N.
    """

    time: NDArray[np.float64]
    estimate: FrictionEstimate
    velocity: NDArray[np.float64]
    friction: NDArray[np.float64]
    rising: NDArray[np.bool_]
    width: float
    claims: tuple[Claim, ...]


def hysteresis(velocity: NDArray[np.float64], friction: NDArray[np.float64], rising: NDArray[np.bool_]) -> float:
    """Largest difference in N between the falling and the rising branch, means over 10 µm/s of velocity."""
    edges = np.arange(-200e-6, 201e-6, 10e-6)
    means = []
    for branch in (rising, ~rising):
        bins = np.digitize(velocity[branch], edges)
        count = np.bincount(bins, minlength=edges.size + 1)
        total = np.bincount(bins, friction[branch], minlength=edges.size + 1)
        # A bin that one branch passes over tells nothing.
        means.append(np.where(count > 0, total / np.maximum(count, 1), np.nan)[1:-1])
    return float(np.nanmax(np.abs(means[1] - means[0])))


def curve_of(response: Response, estimate: FrictionEstimate, coulomb: float) -> FrictionCurve:
    """Put the estimate of a whole run beside the truth, in the periods evaluated."""
    window = evaluated(response)
    inner = FrictionEstimate(estimate.velocity[window], estimate.friction[window])
    velocity, friction = response.velocity[window], response.friction[window]
    # r̈ = −ω² r: the velocity asked for rises while r is negative.
    rising = response.reference[window] < 0.0
    deviation = inner.friction - friction
    width = hysteresis(inner.velocity, inner.friction, rising)
    sliding = np.abs(inner.velocity) > SLIDING
    claims = (
        Claim(
            "Fig. 7: friction estimate, RMS deviation from the truth",
            None,
            float(np.sqrt(np.mean(deviation**2))),
            "N",
            note=f"largest {np.abs(deviation).max():.3f} N; moving cubic of {WINDOW * 1e3:g} ms, M and magnets known",
        ),
        Claim(
            "Fig. 7: friction while sliding, estimated (median)",
            None,
            float(np.median(np.abs(inner.friction[sliding]))),
            "N",
            note=f"the simulated machine has {coulomb:g} N Coulomb friction, and its viscous part",
        ),
        Claim(
            "Fig. 7: width of the hysteresis, estimated",
            None,
            width,
            "N",
            note=f"in the truth {hysteresis(velocity, friction, rising):.2f} N: the bristles bend before they slip",
        ),
    )
    return FrictionCurve(response.time[window], inner, velocity, friction, rising, width, claims)


def compute(machine: Machine) -> FrictionCurve:
    """Estimate friction from the run of Fig. 6, with the machine's own mass and magnets."""
    run = follow_sine(machine.with_law("linear"))
    plant = machine.plant
    estimate = estimate_friction(
        run.reading, run.coil_current, rate=machine.stage.rate, mass=plant.platform.mass, actuator=plant.actuator
    )
    return curve_of(run, estimate, plant.friction.coulomb)


def draw(data: FrictionCurve) -> Figure:
    """Friction over velocity, and both over time."""
    figure, (plane, time) = sheet(TITLE, rows=2, size=(8.0, 8.0))
    plane.plot(data.velocity * 1e6, data.friction, ".", color=GREY, markersize=2.0, label="truth")
    for name, mask, colour, style in (
        ("estimate, velocity rising", data.rising, BLUE, "-"),
        ("estimate, velocity falling", ~data.rising, VERMILION, "--"),
    ):
        # NaN breaks the line where the other branch runs.
        velocity = np.where(mask, data.estimate.velocity, np.nan)
        friction = np.where(mask, data.estimate.friction, np.nan)
        plane.plot(velocity * 1e6, friction, color=colour, linestyle=style, linewidth=1.3, label=name)
    time.plot(data.time, data.friction, color=GREY, linewidth=2.5, label="truth")
    time.plot(data.time, data.estimate.friction, color=BLUE, linewidth=0.9, label="estimate")
    label(plane, "Friction over velocity, two periods", "velocity / (µm/s)", "friction / N")
    label(time, "The same over time", "time / s", "friction / N")
    for axes in (plane, time):
        axes.legend(loc="lower right", fontsize=SMALL)
    return figure
