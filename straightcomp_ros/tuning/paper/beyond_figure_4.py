"""Beyond Fig. 4: from where each law brings the platform back when |i_c| is limited to I0."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from straightcomp_ros.analysis.pictures import BLACK, BLUE, GREY, PALE_BLUE, PALE_VERMILION, VERMILION
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.tuning.paper.claims import Claim, yes
from straightcomp_ros.tuning.paper.drawing import SMALL, label, sheet
from straightcomp_ros.tuning.paper.figure_4 import RELEASED_AT
from straightcomp_ros.tuning.paper.ideal_machine import Machine
from straightcomp_ros.tuning.paper.recovery_region import (
    StartGrid,
    fastest_outward,
    largest_release,
    least_peak,
    peak,
    possible,
    recovers,
    response,
    settling_time,
    start_grid,
)

TITLE = "Beyond Fig. 4: where each law brings the platform back from, |$i_c$| ≤ $I_0$"
PUBLISHED = "law (9), unclamped"
POINTS = 51
"""Of the grid, each way."""
_SHOWN_MS = 80.0
_STYLES = {"linear": GREY, "smc": BLUE, "smc_observer": BLACK, PUBLISHED: VERMILION}


@dataclass(frozen=True, eq=False)
class Recovery:
    """Starts from which the platform comes back, by law, and from which it could at all.

    Attributes:
        machine: as shipped, with |i_c| <= I0.
        grid: the starts.
        peaks: by law, PUBLISHED first: largest |y| in m on the way back, (v, p); infinite where it does not come back.
        possible: whether any current within ±I0 could, (v, p).
        least_peaks: what full current makes of the peaks, through amplifier and delay, (v, p), m.
        releases: by law, y in m over the time in s from a release at 0.6 y0.
    """

    machine: Machine
    grid: StartGrid
    peaks: Mapping[str, NDArray[np.float64]]
    possible: NDArray[np.bool_]
    least_peaks: NDArray[np.float64]
    releases: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    claims: tuple[Claim, ...] = ()

    def share(self, region: NDArray[np.bool_]) -> float:
        """Part of the physical limit's area that ``region`` (v, p) covers; what lies outside of it does not count."""
        return float(np.count_nonzero(region & self.possible) / np.count_nonzero(self.possible))

    def region(self, law: str) -> NDArray[np.bool_]:
        """Whether the platform comes back under ``law``, (v, p)."""
        return self.peaks[law] < self.machine.plant.platform.stop


def compute(machine: Machine, points: int = POINTS) -> Recovery:
    """Start the shipped machine under each law, and the idealised one under (9) unclamped, from all over the grid.

    Friction is on, as the parameter file says.
    """
    limited = machine.with_limit(machine.plant.actuator.bias_current)
    machines = {PUBLISHED: machine.idealised().with_law("smc"), **{law: limited.with_law(law) for law in LAWS}}
    grid = start_grid(limited, points)
    within = grid.filled(lambda y, v: possible(limited, y, v)) > 0.0

    def peaks(law: str, one: Machine) -> NDArray[np.float64]:
        # The unclamped law asks for more than I0, and so is not bound by what I0 can do.
        free = law == PUBLISHED
        return grid.filled(lambda y, v: peak(one, y, v) if free or possible(one, y, v) else np.inf)

    released = RELEASED_AT * machine.plant.actuator.air_gap
    releases = {law: response(one, released) for law, one in machines.items()}
    data = Recovery(
        machine=limited,
        grid=grid,
        peaks={law: peaks(law, one) for law, one in machines.items()},
        possible=within,
        least_peaks=grid.filled(lambda y, v: least_peak(limited, y, v)),
        releases={law: (np.arange(y.size) / machines[law].stage.rate, y) for law, y in releases.items()},
    )
    claims = [claim for law, one in machines.items() for claim in _claims(data, law, one)]
    amplifier = Claim(
        "beyond Fig. 4: region that the amplifier and the delay leave, part of the physical limit",
        None,
        data.share(data.least_peaks < limited.plant.platform.stop),
        "",
        note="full current, but through the amplifier's lag and half a sample late: no law here can reach further",
    )
    return Recovery(**{**vars(data), "claims": (*claims, amplifier)})


def _claims(data: Recovery, law: str, machine: Machine) -> tuple[Claim, Claim]:
    gap, published = machine.plant.actuator.air_gap, law == PUBLISHED
    name = f"{law}," if published else f"{law}, |i_c| ≤ I0,"
    back = recovers(machine, RELEASED_AT * gap)
    settled = settling_time(machine, data.releases[law][1]) * 1e3
    diverges = "it diverges (Fig. 4)"
    return (
        Claim(
            f"beyond Fig. 4: {name} recovers from 0.6 y0 (1 yes, 0 no)",
            0.0 if published else None,
            yes(back),
            "",
            note=diverges if published else f"the paper: {diverges}; here within 1 % of y0 after {settled:.0f} ms",
        ),
        Claim(
            f"beyond Fig. 4: region of recovery, {law}, part of the physical limit",
            None,
            data.share(data.region(law)),
            "",
            note=f"at rest it recovers up to {largest_release(machine) / gap:.2f} y0; the stop is at "
            f"{machine.plant.platform.stop / gap:g} y0",
        ),
    )


def draw(data: Recovery) -> Figure:
    """One phase plane for each law, with the limits; then the release from 0.6 y0 over time under all of them."""
    figure, axes = sheet(TITLE, rows=2, columns=3, size=(12.0, 8.0))
    for place, law in zip(axes, data.peaks, strict=False):
        _plane(place, data, law)
    _over_time(axes[-1], data)
    handles = [
        Patch(color=PALE_BLUE, label="comes back"),
        Patch(color=PALE_VERMILION, label="lost, though some current within ±$I_0$ would bring it back"),
        Line2D([], [], color=BLACK, label="physical limit: full current at once"),
        Line2D([], [], color=BLACK, linestyle="--", label="the same through amplifier and delay"),
        Line2D([], [], color=VERMILION, marker="o", linestyle="", label="Fig. 4: at rest at 0.6 $y_0$"),
    ]
    figure.legend(handles=handles, loc="outside lower center", fontsize=SMALL + 1, ncols=3)
    return figure


def _plane(axes: Axes, data: Recovery, law: str) -> None:
    machine, stop, gap = data.machine, data.machine.plant.platform.stop, data.machine.plant.actuator.air_gap
    a, speed = data.grid.positions / gap, data.grid.velocities * 1e3
    fine = np.linspace(-stop, stop, 401)
    limit = np.array([fastest_outward(machine, y) for y in fine.tolist()]) * 1e3
    axes.fill_between(fine / gap, -limit[::-1], limit, color=PALE_VERMILION, linewidth=0.0)
    # Peaks beyond the stop, where the stop is thought away, let the border be interpolated between the points.
    beyond = np.minimum(data.peaks[law], 1.2 * stop)
    axes.contourf(a, speed, beyond, [0.0, stop], colors=[PALE_BLUE])
    axes.contour(a, speed, beyond, [stop], colors=BLUE, linewidths=0.8)
    for border in (limit, -limit[::-1]):
        axes.plot(fine / gap, border, color=BLACK, linewidth=1.2)
    axes.contour(a, speed, data.least_peaks, [stop], colors=BLACK, linewidths=1.0, linestyles="--")
    axes.plot(RELEASED_AT, 0.0, "o", color=VERMILION, markersize=6)
    if law == PUBLISHED:
        axes.text(-0.76, -420.0, "beyond the limit it\nasks for more than $I_0$", fontsize=SMALL)
    title = f"{law}: {data.share(data.region(law)):.0%} of the limit"
    label(axes, title, "position y(0)/$y_0$ / 1", "velocity ẏ(0) / mm/s")
    axes.set_xlim(-stop / gap, stop / gap)
    axes.set_ylim(1.02 * speed[0], 1.02 * speed[-1])


def _over_time(axes: Axes, data: Recovery) -> None:
    gap = data.machine.plant.actuator.air_gap
    stop = data.machine.plant.platform.stop / gap
    axes.axhline(stop, color=BLACK, linewidth=0.8, linestyle=":", label=f"stop, {stop:g} $y_0$")
    for law, (time, y) in data.releases.items():
        # The stop is thought away: what is beyond it did not happen.
        at_stop = np.flatnonzero(y >= data.machine.plant.platform.stop)[:1]
        shown = slice(0, int(at_stop[0]) + 1 if at_stop.size else None)
        width = 2.5 if law == "linear" else 1.2  # smc goes the same way
        a = np.minimum(y[shown] / gap, stop)
        axes.plot(time[shown] * 1e3, a, color=_STYLES[law], label=law, linewidth=width)
        axes.plot(time[at_stop] * 1e3, np.full(at_stop.size, stop), "x", color=_STYLES[law])
    axes.set_xlim(-1.0, _SHOWN_MS)
    axes.set_ylim(-0.1, 1.0)
    label(axes, "Released at rest at 0.6 $y_0$", "time / ms", "position y/$y_0$ / 1")
    axes.legend(loc="upper right", fontsize=SMALL)
