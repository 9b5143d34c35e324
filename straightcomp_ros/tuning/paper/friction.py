"""Friction on a sine of 0.8 Hz and 50 µm: Fig. 6, stick-slip and lag of linear control, and Fig. 7, friction against
velocity, estimated from recorded signals.

F = f_c(y, i_c) − M ÿ by (1) and (2). y, ẏ and ÿ come from a cubic fitted to the encoder's readings in a moving window
(Savitzky and Golay, Analytical Chemistry 36(8), 1964), and the current is smoothed by the same window, so that all are
of the same time, without lag. A window of 20 ms makes an encoder quantum of 0.1 µm at 2 kHz a noise of 0.3 mm/s² in ÿ
(1 mN at 3 kg); what friction does faster than that is smoothed away.
"""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from straightcomp_ros.analysis.pictures import BLACK, BLUE, GREY, PALE_VERMILION, VERMILION
from straightcomp_ros.model.actuator import ActuatorParameters, magnetic_force
from straightcomp_ros.tuning.paper.figure import SMALL, Claim, label, legend_above, sheet
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


@dataclass(frozen=True, eq=False)
class StickSlip:
    """The run with friction and without it.

    Attributes:
        run, frictionless: the two responses.
        sticks: (m, 2) first and last sample of each stick phase of ``run`` in the periods evaluated.
    """

    run: Response
    frictionless: Response
    sticks: NDArray[np.intp]
    claims: tuple[Claim, ...]

    def draw(self) -> Figure:
        """Reference and position, error, and velocity, with the stick phases shaded."""
        figure, (position, error, velocity) = sheet(
            "Fig. 6: linear control follows a sine of 0.8 Hz, 50 µm", rows=3, size=(8.0, 8.5)
        )
        run, window = self.run, evaluated(self.run)
        time = run.time[window]
        position.plot(time, run.reference[window] * 1e6, color=GREY, linewidth=2.5, label="reference r")
        position.plot(time, run.y[window] * 1e6, color=BLACK, linewidth=0.9, label="position y")
        error.plot(time, (run.reference - run.reading)[window] * 1e6, color=BLUE, linewidth=0.8, label="with friction")
        without = (self.frictionless.reference - self.frictionless.y)[window] * 1e6
        error.plot(
            time, without, color=VERMILION, linestyle="--", linewidth=1.0, label="without friction: the lag alone"
        )
        velocity.plot(time, run.velocity[window] * 1e6, color=BLACK, linewidth=0.6, label="true velocity")
        for axes in (position, error, velocity):
            for number, (first, last) in enumerate(self.sticks):
                name = "platform sticks" if number == 0 else None
                axes.axvspan(run.time[first], run.time[last], color=PALE_VERMILION, linewidth=0.0, zorder=0, label=name)
            axes.margins(x=0.01)
        label(position, "Reference and position", "time / s", "position / µm")
        label(error, "Error r − y (encoder)", "time / s", "error / µm")
        label(velocity, "Velocity", "time / s", "velocity / (µm/s)")
        for axes in (position, error, velocity):
            legend_above(axes, columns=3)
        return figure


def stick_phases(response: Response, coulomb: float) -> NDArray[np.intp]:
    """First and last sample, (m, 2), of each time the platform sticks, in the periods evaluated."""
    held = (np.abs(response.friction) < HELD * coulomb) & evaluated(response)
    edges = np.diff(np.concatenate([[0], held.astype(np.int8), [0]]))
    phases = np.column_stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1])
    return phases[response.time[phases[:, 1]] - response.time[phases[:, 0]] >= SHORTEST_STICK]


def stick_slip(machine: Machine) -> StickSlip:
    """Follow the sine with the machine as it is, and with its friction taken away."""
    linear = machine.with_law("linear")
    run, frictionless = follow_sine(linear), follow_sine(linear.without_friction())
    design = machine.control.smc
    window = evaluated(run)
    error = (run.reference - run.reading)[window]
    lagging = fundamental(frictionless.time[window], (frictionless.reference - frictionless.y)[window])
    sticks = stick_phases(run, machine.plant.friction.coulomb)
    length = float(np.mean(run.time[sticks[:, 1]] - run.time[sticks[:, 0]])) if len(sticks) else 0.0
    exact = following_error_gain(design, OMEGA) * AMPLITUDE
    claims = (
        Claim(
            "Fig. 6: amplitude of the lag without friction",
            None,
            lagging * 1e6,
            "µm",
            note=f"by (12) {exact * 1e6:.3f} µm: a lag of 2ζ/ωn = {lag(design) * 1e3:.2f} ms, whatever the friction",
        ),
        Claim(
            "Fig. 6: largest error with friction",
            None,
            float(np.abs(error).max()) * 1e6,
            "µm",
            note="the lag, and on it a peak after each reversal while the platform sticks",
        ),
        Claim(
            "Fig. 6: stick phases in each period",
            None,
            len(sticks) / PERIODS,
            note=f"one at each reversal, {length * 1e3:.0f} ms long: friction below {HELD:.0%} of Coulomb's",
        ),
    )
    return StickSlip(run, frictionless, sticks, claims)


@dataclass(frozen=True, eq=False)
class FrictionEstimate:
    """Velocity in m/s and friction in N, both (n,); friction is positive where it resists a positive velocity."""

    velocity: NDArray[np.float64]
    friction: NDArray[np.float64]


def smoothed(values: NDArray[np.float64], rate: float, derivative: int = 0) -> NDArray[np.float64]:
    """Value or derivative in time of the moving cubic through ``values`` (n,) at ``rate`` samples per second."""
    samples = 2 * round(0.5 * WINDOW * rate) + 1
    return np.asarray(savgol_filter(values, samples, _ORDER, deriv=derivative, delta=1.0 / rate))


def estimate_friction(
    y: NDArray[np.float64], current: NDArray[np.float64], *, rate: float, mass: float, actuator: ActuatorParameters
) -> FrictionEstimate:
    """Estimate velocity and friction from a record; the ends, half a window long, are less certain.

    The magnets' negative stiffness counts: an error of 1 µm in where y is zero is 30 mN with the magnets of
    the shipped parameters. ``y`` (n,) are the encoder's readings in m, ``current`` (n,) is the measured control current
    in A, ``rate`` in samples per second, ``mass`` M in kg, ``actuator`` the magnets as far as they are known.
    """
    constants, bias = actuator.constants(), actuator.bias_current
    # (2) is arithmetic only: arrays pass through it as numbers do.
    force = magnetic_force(constants, smoothed(y, rate), bias, smoothed(current, rate))  # type: ignore[arg-type]
    return FrictionEstimate(smoothed(y, rate, 1), force - mass * smoothed(y, rate, 2))


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

    def draw(self) -> Figure:
        """Friction over velocity, and both over time."""
        figure, (plane, time) = sheet("Fig. 7: friction against velocity", rows=2, size=(8.0, 8.0))
        plane.plot(self.velocity * 1e6, self.friction, ".", color=GREY, markersize=2.0, label="truth")
        for name, mask, colour, style in (
            ("estimate, velocity rising", self.rising, BLUE, "-"),
            ("estimate, velocity falling", ~self.rising, VERMILION, "--"),
        ):
            # NaN breaks the line where the other branch runs.
            velocity = np.where(mask, self.estimate.velocity, np.nan)
            friction = np.where(mask, self.estimate.friction, np.nan)
            plane.plot(velocity * 1e6, friction, color=colour, linestyle=style, linewidth=1.3, label=name)
        time.plot(self.time, self.friction, color=GREY, linewidth=2.5, label="truth")
        time.plot(self.time, self.estimate.friction, color=BLUE, linewidth=0.9, label="estimate")
        label(plane, "Friction over velocity, two periods", "velocity / (µm/s)", "friction / N")
        label(time, "The same over time", "time / s", "friction / N")
        for axes in (plane, time):
            axes.legend(loc="lower right", fontsize=SMALL)
        return figure


def hysteresis(velocity: NDArray[np.float64], friction: NDArray[np.float64], rising: NDArray[np.bool_]) -> float:
    """Largest difference in N between the falling and the rising branch, means over 10 µm/s of velocity."""
    edges = np.arange(-200e-6, 201e-6, 10e-6)
    means = []
    for branch in (rising, ~rising):
        bins = np.digitize(velocity[branch], edges)
        count = np.bincount(bins, minlength=edges.size + 1)
        total = np.bincount(bins, friction[branch], minlength=edges.size + 1)
        # A bin that one branch passes over has no mean.
        means.append(np.where(count > 0, total / np.maximum(count, 1), np.nan)[1:-1])
    return float(np.nanmax(np.abs(means[1] - means[0])))


def friction_curve(machine: Machine) -> FrictionCurve:
    """Estimate friction from the run of Fig. 6, with the machine's own mass and magnets, and compare with the truth."""
    run, plant = follow_sine(machine.with_law("linear")), machine.plant
    estimate = estimate_friction(
        run.reading, run.coil_current, rate=machine.stage.rate, mass=plant.platform.mass, actuator=plant.actuator
    )
    window = evaluated(run)
    inner = FrictionEstimate(estimate.velocity[window], estimate.friction[window])
    velocity, friction = run.velocity[window], run.friction[window]
    # r̈ = −ω² r: the velocity asked for rises while r is negative.
    rising = run.reference[window] < 0.0
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
            note=f"the simulated machine has {plant.friction.coulomb:g} N Coulomb friction, and its viscous part",
        ),
        Claim(
            "Fig. 7: width of the hysteresis, estimated",
            None,
            width,
            "N",
            note=f"in the truth {hysteresis(velocity, friction, rising):.2f} N: the bristles bend before they slip",
        ),
    )
    return FrictionCurve(run.time[window], inner, velocity, friction, rising, width, claims)
