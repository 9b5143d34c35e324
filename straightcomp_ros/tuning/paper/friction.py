"""Friction on a sine of 0.8 Hz and 50 µm: Fig. 6, stick-slip and lag of linear control, and Fig. 7, friction against
velocity, estimated from recorded signals.

F = f_c(y, i_c) − M ÿ by (1) and (2). y, ẏ and ÿ come from a cubic fitted to the encoder's readings in a moving window
(Savitzky and Golay, Analytical Chemistry 36(8), 1964), and the current is smoothed by the same window, so that all are
of the same time, without lag. A window of 20 ms makes an encoder quantum of 0.1 µm at 2 kHz a noise of 0.3 mm/s² in ÿ
(1 mN at 3 kg); what friction does faster than that is smoothed away.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter
from scipy.stats import binned_statistic

from straightcomp_ros.analysis.pictures import label, legend_above
from straightcomp_ros.analysis.record import runs_of
from straightcomp_ros.analysis.style import BLACK, BLUE, GREY, PALE_VERMILION, VERMILION
from straightcomp_ros.model.actuator import ActuatorParameters, magnetic_force
from straightcomp_ros.straightness.residual import rms
from straightcomp_ros.tuning.paper.figure import SMALL, Claim, PaperFigure, sheet
from straightcomp_ros.tuning.paper.machine import (
    AMPLITUDE,
    OMEGA,
    PERIODS,
    Machine,
    Response,
    evaluated,
    follow_sine,
    fundamental,
)
from straightcomp_ros.tuning.paper.surface import following_error_gain, lag

HELD = 0.95
"""Fraction of Coulomb friction below which the bristles hold: the platform sticks, and only creeps with them."""
SHORTEST_STICK = 5e-3
"""s; shorter ones are the loop's own tremor."""
SLIDING = 150e-6
"""Speed in m/s from which the platform slides in earnest: there friction is Coulomb's."""
WINDOW = 0.02
"""Length of the moving window in s."""
_ORDER = 3


def stick_phases(response: Response, coulomb: float) -> NDArray[np.intp]:
    """First and last sample, (m, 2), of each time the platform sticks."""
    phases = runs_of(np.abs(response.friction) < HELD * coulomb) - [0, 1]
    return phases[np.diff(response.time[phases])[:, 0] >= SHORTEST_STICK]


def stick_slip(machine: Machine) -> PaperFigure:
    """Fig. 6: follow the sine with the machine as it is, and with its friction taken away.

    Reference and position, error, and velocity, with the stick phases shaded.
    """
    linear = machine.with_law("linear")
    run, frictionless = (evaluated(follow_sine(one)) for one in (linear, linear.without_friction()))
    error, without = run.reference - run.reading, frictionless.reference - frictionless.y
    sticks = run.time[stick_phases(run, machine.plant.friction.coulomb)]

    figure, places = sheet("Fig. 6: linear control follows a sine of 0.8 Hz, 50 µm", "a;b;c", size=(8.0, 8.5))
    position, errors, velocity = places
    position.plot(run.time, run.reference * 1e6, color=GREY, linewidth=2.5, label="reference r")
    position.plot(run.time, run.y * 1e6, color=BLACK, linewidth=0.9, label="position y")
    errors.plot(run.time, error * 1e6, color=BLUE, linewidth=0.8, label="with friction")
    alone = "without friction: the lag alone"
    errors.plot(run.time, without * 1e6, color=VERMILION, linestyle="--", linewidth=1.0, label=alone)
    velocity.plot(run.time, run.velocity * 1e6, color=BLACK, linewidth=0.6, label="true velocity")
    for axes in places:
        for number, (first, last) in enumerate(sticks):
            name = None if number else "platform sticks"
            axes.axvspan(first, last, color=PALE_VERMILION, linewidth=0.0, zorder=0, label=name)
        axes.margins(x=0.01)
    label(position, "Reference and position", "time / s", "position / µm")
    label(errors, "Error r − y (encoder)", "time / s", "error / µm")
    label(velocity, "Velocity", "time / s", "velocity / (µm/s)")
    for axes in places:
        legend_above(axes, ncols=3)

    design = machine.control.smc
    exact = following_error_gain(design, OMEGA) * AMPLITUDE
    by_12 = f"by (12) {exact * 1e6:.3f} µm: a lag of 2ζ/ωn = {lag(design) * 1e3:.2f} ms, whatever the friction"
    peaks = "the lag, and on it a peak after each reversal while the platform sticks"
    length = float(np.mean(sticks[:, 1] - sticks[:, 0])) if len(sticks) else 0.0
    held = f"one at each reversal, {length * 1e3:.0f} ms long: friction below {HELD:.0%} of Coulomb's"
    lagging = fundamental(run.time, without)
    claims = (
        Claim("Fig. 6: amplitude of the lag without friction", lagging * 1e6, "µm", by_12),
        Claim("Fig. 6: largest error with friction", float(np.abs(error).max()) * 1e6, "µm", peaks),
        Claim("Fig. 6: stick phases in each period", len(sticks) / PERIODS, "", held),
    )
    return PaperFigure(claims, figure)


def smoothed(values: NDArray[np.float64], rate: float, derivative: int = 0) -> NDArray[np.float64]:
    """Value or derivative in time of the moving cubic through ``values`` (n,) at ``rate`` samples per second."""
    samples = 2 * round(0.5 * WINDOW * rate) + 1
    return np.asarray(savgol_filter(values, samples, _ORDER, deriv=derivative, delta=1.0 / rate))


def estimate_friction(
    y: NDArray[np.float64], current: NDArray[np.float64], *, rate: float, mass: float, actuator: ActuatorParameters
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Velocity (n,) in m/s and friction (n,) in N, positive where it resists a positive velocity; the ends, half a
    window long, are less certain.

    The magnets' negative stiffness counts: an error of 1 µm in where y is zero is 30 mN with the magnets of
    the shipped parameters. ``y`` (n,) are the encoder's readings in m, ``current`` (n,) is the measured control current
    in A, ``rate`` in samples per second, ``mass`` M in kg, ``actuator`` the magnets as far as they are known.
    """
    constants, bias = actuator.constants(), actuator.bias_current
    # (2) is arithmetic only: arrays pass through it as numbers do.
    force = magnetic_force(constants, smoothed(y, rate), bias, smoothed(current, rate))  # type: ignore[arg-type]
    return smoothed(y, rate, 1), np.asarray(force - mass * smoothed(y, rate, 2))


def hysteresis(velocity: NDArray[np.float64], friction: NDArray[np.float64], rising: NDArray[np.bool_]) -> float:
    """Largest difference in N between the falling and the rising branch, means over 10 µm/s of velocity."""
    edges = np.arange(-200e-6, 201e-6, 10e-6)
    # A bin that one branch passes over has no mean: NaN.
    up, down = (binned_statistic(velocity[one], friction[one], "mean", edges).statistic for one in (rising, ~rising))
    return float(np.nanmax(np.abs(down - up)))


def friction_curve(machine: Machine) -> PaperFigure:
    """Fig. 7: friction estimated from the run of Fig. 6, with the machine's own mass and magnets, and the truth.

    Over velocity, and over time.
    """
    whole, plant = follow_sine(machine.with_law("linear")), machine.plant
    run = evaluated(whole)
    estimates = estimate_friction(
        whole.reading, whole.coil_current, rate=machine.stage.rate, mass=plant.platform.mass, actuator=plant.actuator
    )
    velocity, friction = (values[-run.time.size :] for values in estimates)
    # r̈ = −ω² r: the velocity asked for rises while r is negative.
    rising = run.reference < 0.0

    figure, (plane, time) = sheet("Fig. 7: friction against velocity", "a;b", size=(8.0, 8.0))
    plane.plot(run.velocity * 1e6, run.friction, ".", color=GREY, markersize=2.0, label="truth")
    for name, mask, colour, style in (("rising", rising, BLUE, "-"), ("falling", ~rising, VERMILION, "--")):
        # NaN breaks the line where the other branch runs.
        branch = (np.where(mask, values, np.nan) for values in (velocity * 1e6, friction))
        plane.plot(*branch, color=colour, linestyle=style, linewidth=1.3, label=f"estimate, velocity {name}")
    time.plot(run.time, run.friction, color=GREY, linewidth=2.5, label="truth")
    time.plot(run.time, friction, color=BLUE, linewidth=0.9, label="estimate")
    label(plane, "Friction over velocity, two periods", "velocity / (µm/s)", "friction / N")
    label(time, "The same over time", "time / s", "friction / N")
    for axes in (plane, time):
        axes.legend(loc="lower right", fontsize=SMALL)

    deviation = friction - run.friction
    most = np.abs(deviation).max()
    method = f"largest {most:.3f} N; moving cubic of {WINDOW * 1e3:g} ms, M and magnets known"
    sliding = float(np.median(np.abs(friction[np.abs(velocity) > SLIDING])))
    coulomb = f"the simulated machine has {plant.friction.coulomb:g} N Coulomb friction, and its viscous part"
    truth = hysteresis(run.velocity, run.friction, rising)
    bristles = f"in the truth {truth:.2f} N: the bristles bend before they slip"
    claims = (
        Claim("Fig. 7: friction estimate, RMS deviation from the truth", rms(deviation), "N", method),
        Claim("Fig. 7: friction while sliding, estimated (median)", sliding, "N", coulomb),
        Claim("Fig. 7: width of the hysteresis, estimated", hysteresis(velocity, friction, rising), "N", bristles),
    )
    return PaperFigure(claims, figure)
