"""Beyond Fig. 4: from which position and velocity a law brings the platform back, and from which the magnets could.

With |i_c| <= I0 the force of (2) is the more negative the more negative i_c, wherever the platform is, and with
i_c = −I0 it is −μ0 N² A I0² / (y0 + y)²: the near magnet is off. So there is no point of no return inside the air gap,
and a platform is lost only if it moves outward so fast that even full current does not stop it before its stop.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from straightcomp_ros.analysis.pictures import label
from straightcomp_ros.analysis.style import BLACK, BLUE, PALE_BLUE, PALE_VERMILION, VERMILION
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.control.margins import bisected
from straightcomp_ros.model.plant import plant_state
from straightcomp_ros.offline.scenario import run_cycle
from straightcomp_ros.tuning.paper.figure import SMALL, Claim, PaperFigure, legend_below, sheet
from straightcomp_ros.tuning.paper.gain_error import FAR
from straightcomp_ros.tuning.paper.machine import Machine

PUBLISHED = "law (9), unclamped"
POINTS = 51
"""Of the grid, each way."""
SHOWN = ("linear", "smc", "smc_observer")
"""Laws of the figure."""
RETURNED = 0.01
"""|y/y0| within which the platform must stay at the end."""
_DURATION = 0.5
"""s; the slowest law needs 0.17 from 0.6 y0."""
_HELD = 0.01
"""s at the end for which the platform must have stayed."""
_MOVED_STOP = 0.95
"""Part of the air gap to which the stop is moved in the simulation, so that a touch between two samples is not lost."""


def fastest_outward(machine: Machine, y: float) -> float:
    """Largest ẏ in m/s at ``y`` in m that i_c = −I0, at once, brings to zero before the stop; without friction.

    The work of −μ0 N² A I0² / (y0 + y)² up to the stop is the kinetic energy.
    """
    strength = machine.plant.actuator.current_stiffness * machine.bias * machine.gap**2
    work = strength * (1.0 / (machine.gap + y) - 1.0 / (machine.gap + machine.stop))
    return math.sqrt(2.0 * max(0.0, work) / machine.plant.platform.mass)


def possible(machine: Machine, y: float, velocity: float) -> bool:
    """Whether some current within ±I0, if it came at once, would keep the platform off its stops."""
    within = abs(y) < machine.stop
    return within and velocity < fastest_outward(machine, y) and -velocity < fastest_outward(machine, -y)


def response(machine: Machine, y: float, velocity: float = 0.0) -> NDArray[np.float64]:
    """True y (n,) in m at the samples after a start at ``y`` in m with ``velocity`` in m/s, the stop out of the way:
    the platform recovers if it does not come to where the stop is.

    The start is a blow: at the first sample the law knows of a platform at rest, and learns its velocity from the
    readings that follow. The bias current is on, the control current zero. Shorter if the law's current is not finite.
    """
    count, period_ns = machine.samples(_DURATION), machine.stage.period_ns
    platform = replace(machine.plant.platform, stop=max(machine.stop, _MOVED_STOP * machine.gap))
    delays = np.full(count, round(machine.stage.drive.delay * period_ns))
    given = np.arange(count) * period_ns, delays, np.zeros((count, 3))
    law, initial = make_law(machine.control, machine.stage), plant_state(y=y, velocity=velocity, bias=machine.bias)
    return run_cycle(law, replace(machine.plant, platform=platform), *given, initial=initial).true_y


def settling_time(machine: Machine, true_y: NDArray[np.float64]) -> float:
    """Time in s after which |y| of a :func:`response` stays within `RETURNED` y0; infinite if there is none."""
    if true_y.size < machine.samples(_DURATION):
        return math.inf
    outside = np.flatnonzero(np.abs(true_y) >= RETURNED * machine.gap)
    settled = float(outside[-1] + 1) / machine.stage.rate if outside.size else 0.0
    return settled if settled <= _DURATION - _HELD else math.inf


def peak(machine: Machine, y: float, velocity: float = 0.0) -> float:
    """Largest |y| in m on the way to rest at the centre; infinite if the law does not bring the platform there."""
    true_y = response(machine, y, velocity)
    return float(np.abs(true_y).max()) if settling_time(machine, true_y) < math.inf else math.inf


def recovers(machine: Machine, y: float) -> bool:
    """Whether the law brings a platform at rest at ``y`` in m to rest at the centre, without its touching a stop."""
    return peak(machine, y) < machine.stop


class Regions(NamedTuple):
    """Starts from which the platform comes back, by law, and from which it could at all."""

    machine: Machine  # as shipped, with |i_c| <= I0
    positions: NDArray[np.float64]  # of the starts, (p,) in m, symmetric about zero and odd in number
    velocities: NDArray[np.float64]  # the same, (v,) in m/s
    possible: NDArray[np.bool_]  # whether any current within ±I0 could, (v, p)
    # Largest |y| in m on the way back, (v, p), infinite where it does not come back: by law, PUBLISHED first.
    peaks: Mapping[str, NDArray[np.float64]]

    def back(self, law: str) -> NDArray[np.bool_]:
        """Whether the platform comes back, (v, p)."""
        return self.peaks[law] < self.machine.stop

    def share(self, law: str) -> float:
        """Part of the physical limit's area from which it comes back; what lies outside of it does not count."""
        return float(np.count_nonzero(self.back(law) & self.possible) / np.count_nonzero(self.possible))


def machines_of(machine: Machine) -> dict[str, Machine]:
    """The idealised machine under (9) unclamped, and the shipped one with |i_c| <= I0 under each law."""
    limited = machine.with_limit(machine.bias)
    return {PUBLISHED: machine.idealised().with_law("smc"), **{law: limited.with_law(law) for law in SHOWN}}


def regions(machine: Machine, points: int = POINTS) -> Regions:
    """Start the machines from all over the grid: all positions between the stops, and all velocities that any of them
    allows. Friction is on, as the parameter file says."""
    limited = machine.with_limit(machine.bias)
    fastest = fastest_outward(limited, -limited.stop)
    positions, velocities = np.linspace(-limited.stop, limited.stop, points), np.linspace(-fastest, fastest, points)

    def over_grid(value: Callable[[float, float], float]) -> NDArray[np.float64]:
        """``value(y, velocity)``; computed for velocities >= 0, mirrored through the centre."""
        rows = [[value(y, v) for y in positions.tolist()] for v in velocities.tolist() if v >= 0.0]
        upper = np.array(rows, dtype=float)
        return np.concatenate([upper[:0:-1, ::-1], upper])

    def peaks(law: str, one: Machine) -> NDArray[np.float64]:
        # The unclamped law asks for more than I0, and so is not bound by what I0 can do.
        free = law == PUBLISHED
        return over_grid(lambda y, v: peak(one, y, v) if free or possible(one, y, v) else np.inf)

    found = {law: peaks(law, one) for law, one in machines_of(machine).items()}
    return Regions(limited, positions, velocities, over_grid(lambda y, v: possible(limited, y, v)) > 0.0, found)


def recovery(machine: Machine) -> PaperFigure:
    """Beyond Fig. 4: one phase plane for each law, with the physical limit."""
    data, machines = regions(machine), machines_of(machine)
    title = "Beyond Fig. 4: where each law brings the platform back from, |$i_c$| ≤ $I_0$"
    figure, planes = sheet(title, "ab;cd", size=(9.0, 8.0))
    for axes, law in zip(planes, machines, strict=True):
        _plane(axes, data, law)
    handles = [
        Patch(color=PALE_BLUE, label="comes back"),
        Patch(color=PALE_VERMILION, label="lost, though some current within ±$I_0$ would bring it back"),
        Line2D([], [], color=BLACK, label="physical limit: full current at once"),
        Line2D([], [], color=VERMILION, marker="o", linestyle="", label="Fig. 4: at rest at 0.6 $y_0$"),
    ]
    legend_below(figure, handles=handles, fontsize=SMALL + 1, ncols=2)

    claims = []
    for law, one in machines.items():
        name = f"{law}, recovers" if law == PUBLISHED else f"{law}, |i_c| ≤ I0, recovers"
        settled = settling_time(one, response(one, FAR * one.gap)) * 1e3
        diverges = "it diverges (Fig. 4)"
        note = diverges if law == PUBLISHED else f"the paper: {diverges}; here within 1 % of y0 after {settled:.0f} ms"
        farthest = bisected(lambda y, one=one: recovers(one, y), 0.0, one.stop, 8)  # type: ignore[misc]
        reach = f"at rest it recovers up to {farthest / one.gap:.2f} y0; the stop is at {one.stop / one.gap:g} y0"
        paper, back = 0.0 if law == PUBLISHED else None, float(recovers(one, FAR * one.gap))
        claims += [
            Claim(f"beyond Fig. 4: {name} from 0.6 y0 (1 yes, 0 no)", back, "", note, paper),
            Claim(f"beyond Fig. 4: region of recovery, {law}, part of the physical limit", data.share(law), "", reach),
        ]
    return PaperFigure(claims, figure)


def _plane(axes: Axes, data: Regions, law: str) -> None:
    machine, stop, gap = data.machine, data.machine.stop, data.machine.gap
    a, speed = data.positions / gap, data.velocities * 1e3
    fine = np.linspace(-stop, stop, 401)
    limit = np.array([fastest_outward(machine, y) for y in fine.tolist()]) * 1e3
    axes.fill_between(fine / gap, -limit[::-1], limit, color=PALE_VERMILION, linewidth=0.0)
    # Peaks beyond the stop, where the stop is thought away, let the border be interpolated between the points.
    beyond = np.minimum(data.peaks[law], 1.2 * stop)
    axes.contourf(a, speed, beyond, [0.0, stop], colors=[PALE_BLUE])
    axes.contour(a, speed, beyond, [stop], colors=BLUE, linewidths=0.8)
    for border in (limit, -limit[::-1]):
        axes.plot(fine / gap, border, color=BLACK, linewidth=1.2)
    axes.plot(FAR, 0.0, "o", color=VERMILION, markersize=6)
    if law == PUBLISHED:
        axes.text(-0.76, -420.0, "beyond the limit it\nasks for more than $I_0$", fontsize=SMALL)
    label(axes, f"{law}: {data.share(law):.0%} of the limit", "position y(0)/$y_0$ / 1", "velocity ẏ(0) / mm/s")
    axes.set_xlim(-stop / gap, stop / gap)
    axes.set_ylim(1.02 * speed[0], 1.02 * speed[-1])
