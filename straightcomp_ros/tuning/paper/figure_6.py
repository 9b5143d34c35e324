"""Fig. 6: stick-slip and lag of linear control on a sine of 0.8 Hz and 50 µm."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from straightcomp_ros.analysis.pictures import BLACK, BLUE, GREY, PALE_VERMILION, VERMILION
from straightcomp_ros.tuning.paper.claims import Claim
from straightcomp_ros.tuning.paper.drawing import label, legend_above, sheet
from straightcomp_ros.tuning.paper.ideal_machine import Machine
from straightcomp_ros.tuning.paper.release import Response
from straightcomp_ros.tuning.paper.sine import AMPLITUDE, OMEGA, PERIODS, evaluated, follow_sine, fundamental
from straightcomp_ros.tuning.paper.surface import following_error_gain, lag

TITLE = "Fig. 6: linear control follows a sine of 0.8 Hz, 50 µm"
HELD = 0.95
"""Fraction of Coulomb friction below which the bristles hold: the platform sticks, and only creeps with them."""
SHORTEST_STICK = 5e-3
"""s; shorter ones are the loop's own tremor."""


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


def stick_phases(response: Response, coulomb: float) -> NDArray[np.intp]:
    """First and last sample, (m, 2), of each time the platform sticks, in the periods evaluated."""
    held = (np.abs(response.friction) < HELD * coulomb) & evaluated(response)
    edges = np.diff(np.concatenate([[0], held.astype(np.int8), [0]]))
    phases = np.column_stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1])
    return phases[response.time[phases[:, 1]] - response.time[phases[:, 0]] >= SHORTEST_STICK]


def compute(machine: Machine) -> StickSlip:
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
            "",
            note=f"one at each reversal, {length * 1e3:.0f} ms long: friction below {HELD:.0%} of Coulomb's",
        ),
    )
    return StickSlip(run, frictionless, sticks, claims)


def draw(data: StickSlip) -> Figure:
    """Reference and position, error, and velocity, with the stick phases shaded."""
    figure, (position, error, velocity) = sheet(TITLE, rows=3, size=(8.0, 8.5))
    run, window = data.run, evaluated(data.run)
    time = run.time[window]
    position.plot(time, run.reference[window] * 1e6, color=GREY, linewidth=2.5, label="reference r")
    position.plot(time, run.y[window] * 1e6, color=BLACK, linewidth=0.9, label="position y")
    error.plot(time, (run.reference - run.reading)[window] * 1e6, color=BLUE, linewidth=0.8, label="with friction")
    without = (data.frictionless.reference - data.frictionless.y)[window] * 1e6
    error.plot(time, without, color=VERMILION, linestyle="--", linewidth=1.0, label="without friction: the lag alone")
    velocity.plot(time, run.velocity[window] * 1e6, color=BLACK, linewidth=0.6, label="true velocity")
    for axes in (position, error, velocity):
        for number, (first, last) in enumerate(data.sticks):
            name = "platform sticks" if number == 0 else None
            axes.axvspan(run.time[first], run.time[last], color=PALE_VERMILION, linewidth=0.0, zorder=0, label=name)
        axes.margins(x=0.01)
    label(position, "Reference and position", "time / s", "position / µm")
    label(error, "Error r − y (encoder)", "time / s", "error / µm")
    label(velocity, "Velocity", "time / s", "velocity / (µm/s)")
    for axes in (position, error, velocity):
        legend_above(axes, columns=3)
    return figure
