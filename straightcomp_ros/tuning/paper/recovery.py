"""Beyond Fig. 4: from which position and velocity a law brings the platform back, and from which the magnets could.

With |i_c| <= I0 the force of (2) is the more negative the more negative i_c, wherever the platform is, and with
i_c = −I0 it is −μ0 N² A I0² / (y0 + y)²: the near magnet is off. So there is no point of no return inside the air gap,
and a platform is lost only if it moves outward so fast that even full current does not stop it before its stop.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from straightcomp_ros.analysis.pictures import BLACK, BLUE, GREY, PALE_BLUE, PALE_VERMILION, VERMILION
from straightcomp_ros.control.laws import LAWS, make_law
from straightcomp_ros.model.plant import PlantState, advance, as_array
from straightcomp_ros.offline.kernel import Conditions, run_cycle
from straightcomp_ros.tuning.paper.figure import SMALL, Claim, label, sheet
from straightcomp_ros.tuning.paper.gain_error import FAR
from straightcomp_ros.tuning.paper.machine import Machine, largest

PUBLISHED = "law (9), unclamped"
POINTS = 51
"""Of the grid, each way."""
_SHOWN_MS = 80.0
_STYLES = {"linear": GREY, "smc": BLUE, "smc_observer": BLACK, PUBLISHED: VERMILION}
RETURNED = 0.01
"""|y/y0| within which the platform must stay at the end."""
_DURATION = 0.5
"""s; the slowest law needs 0.17 from 0.6 y0."""
_HELD = 0.01
"""s at the end for which the platform must have stayed."""
_FULL_CURRENT_FOR = 0.1
"""s; from one stop to the other it takes 0.03."""
_MOVED_STOP = 0.95
"""Part of the air gap to which the stop is moved in the simulation, so that a touch between two samples is not lost."""


@dataclass(frozen=True, eq=False)
class StartGrid:
    """Positions (p,) in m and velocities (v,) in m/s at the start, both symmetric about zero and odd in number."""

    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]

    def filled(self, value: Callable[[float, float], float]) -> NDArray[np.float64]:
        """``value(y, velocity)`` at all points, (v, p); computed for velocities >= 0, mirrored through the centre."""
        upper = np.array(
            [[value(y, v) for y in self.positions.tolist()] for v in self.velocities.tolist() if v >= 0.0], dtype=float
        )
        return np.concatenate([upper[:0:-1, ::-1], upper])


def fastest_outward(machine: Machine, y: float) -> float:
    """Largest ẏ in m/s at ``y`` in m that i_c = −I0, at once, brings to zero before the stop; without friction.

    The work of −μ0 N² A I0² / (y0 + y)² up to the stop is the kinetic energy.
    """
    actuator = machine.plant.actuator
    strength = actuator.current_stiffness * actuator.bias_current * actuator.air_gap**2
    work = strength * (1.0 / (actuator.air_gap + y) - 1.0 / (actuator.air_gap + machine.plant.platform.stop))
    return math.sqrt(2.0 * max(0.0, work) / machine.plant.platform.mass)


def possible(machine: Machine, y: float, velocity: float) -> bool:
    """Whether some current within ±I0, if it came at once, would keep the platform off its stops."""
    stop = machine.plant.platform.stop
    return abs(y) < stop and velocity < fastest_outward(machine, y) and -velocity < fastest_outward(machine, -y)


def least_peak(machine: Machine, y: float, velocity: float) -> float:
    """Largest way in m toward either stop under full current away from it, through amplifier and delay.

    The first command acts late by the delay, and the current rises from zero. No law of this machine can do better: at
    any time no current leaves the platform further from a stop than full current away from it. The
    mechanical stop is out of the way, as in :func:`peak`.
    """
    return max(_under_full_current(machine, y, velocity), _under_full_current(machine, -y, -velocity))


def _under_full_current(machine: Machine, y: float, velocity: float) -> float:
    """Largest y in m under i_c = −I0, until the platform is at the other stop or beyond this one."""
    period_ns = round(1e9 / machine.stage.rate)
    delay_ns = round(machine.stage.drive.delay * period_ns)
    bias, stop = machine.plant.actuator.bias_current, machine.plant.platform.stop
    wide = _beyond_its_stop(machine).plant
    constants = as_array(wide.constants())
    state = np.array(PlantState(y=y, velocity=velocity, bias=bias))
    largest, asked = y, 0.0
    for _ in range(round(_FULL_CURRENT_FOR * machine.stage.rate)):
        if not -stop < state[0] < wide.platform.stop:
            break
        advance(constants, state, bias, asked, delay_ns, -bias, period_ns - delay_ns)
        asked = -bias
        largest = max(largest, float(state[0]))
    return largest


def peak(machine: Machine, y: float, velocity: float = 0.0) -> float:
    """Largest |y| in m on the way to rest at the centre; infinite if the law does not bring the platform there.

    The start is a blow: at the first sample the law knows of a platform at rest at ``y``, and learns its velocity from
    the readings that follow. The bias current is on, the control current zero. The mechanical stop is out of the way:
    the platform recovers if it does not come to where the stop is.

    Args:
        machine: plant, law and its limit of the current, sampling.
        y: m.
        velocity: m/s.
    """
    true_y = response(machine, y, velocity)
    return float(np.abs(true_y).max()) if settling_time(machine, true_y) < math.inf else math.inf


def recovers(machine: Machine, y: float) -> bool:
    """Whether the law brings a platform at rest at ``y`` in m to rest at the centre, without its touching a stop."""
    return peak(machine, y) < machine.plant.platform.stop


def settling_time(machine: Machine, true_y: NDArray[np.float64]) -> float:
    """Time in s after which |y| of a :func:`response` stays within `RETURNED` y0; infinite if there is none."""
    if true_y.size < _samples(machine):
        return math.inf
    outside = np.flatnonzero(np.abs(true_y) >= RETURNED * machine.plant.actuator.air_gap)
    settled = float(outside[-1] + 1) / machine.stage.rate if outside.size else 0.0
    return settled if settled <= _DURATION - _HELD else math.inf


def response(machine: Machine, y: float, velocity: float = 0.0) -> NDArray[np.float64]:
    """True y (n,) in m at the samples after a start at ``y`` in m with ``velocity`` in m/s, the stop out of the way.

    Shorter than the others if the law's current is not finite.
    """
    count = _samples(machine)
    period_ns = round(1e9 / machine.stage.rate)
    conditions = Conditions(
        stamps=np.arange(count) * period_ns,
        delays=np.full(count, round(machine.stage.drive.delay * period_ns)),
        references=np.zeros((count, 3)),
        noise=np.zeros(count),
    )
    initial = PlantState(y=y, velocity=velocity, bias=machine.plant.actuator.bias_current)
    law = make_law(machine.control, machine.stage)
    return run_cycle(law, _beyond_its_stop(machine).plant, conditions, initial).true_y


def largest_release(machine: Machine, steps: int = 8) -> float:
    """Largest y in m from which a platform at rest recovers, by bisection between the centre and the stop."""
    return largest(lambda y: recovers(machine, y), 0.0, machine.plant.platform.stop, steps)


def _samples(machine: Machine) -> int:
    return round(_DURATION * machine.stage.rate)


def _beyond_its_stop(machine: Machine) -> Machine:
    gap = machine.plant.actuator.air_gap
    wide = max(machine.plant.platform.stop, _MOVED_STOP * gap)
    return dataclasses.replace(
        machine,
        plant=dataclasses.replace(machine.plant, platform=dataclasses.replace(machine.plant.platform, stop=wide)),
    )


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

    def draw(self) -> Figure:
        """One phase plane for each law, with the limits; then the release from 0.6 y0 over time under all of them."""
        figure, axes = sheet(
            "Beyond Fig. 4: where each law brings the platform back from, |$i_c$| ≤ $I_0$",
            rows=2,
            columns=3,
            size=(12.0, 8.0),
        )
        for place, law in zip(axes, self.peaks, strict=False):
            _plane(place, self, law)
        _over_time(axes[-1], self)
        handles = [
            Patch(color=PALE_BLUE, label="comes back"),
            Patch(color=PALE_VERMILION, label="lost, though some current within ±$I_0$ would bring it back"),
            Line2D([], [], color=BLACK, label="physical limit: full current at once"),
            Line2D([], [], color=BLACK, linestyle="--", label="the same through amplifier and delay"),
            Line2D([], [], color=VERMILION, marker="o", linestyle="", label="Fig. 4: at rest at 0.6 $y_0$"),
        ]
        figure.legend(handles=handles, loc="outside lower center", fontsize=SMALL + 1, ncols=3)
        return figure


def recovery(machine: Machine, points: int = POINTS) -> Recovery:
    """Start the shipped machine under each law, and the idealised one under (9) unclamped, from all over the grid.

    Friction is on, as the parameter file says.
    """
    limited = machine.with_limit(machine.plant.actuator.bias_current)
    machines = {PUBLISHED: machine.idealised().with_law("smc"), **{law: limited.with_law(law) for law in LAWS}}
    stop, fastest = limited.plant.platform.stop, fastest_outward(limited, -limited.plant.platform.stop)
    # All positions between the stops, and all velocities that any of them allows.
    grid = StartGrid(np.linspace(-stop, stop, points), np.linspace(-fastest, fastest, points))
    within = grid.filled(lambda y, v: possible(limited, y, v)) > 0.0

    def peaks(law: str, one: Machine) -> NDArray[np.float64]:
        # The unclamped law asks for more than I0, and so is not bound by what I0 can do.
        free = law == PUBLISHED
        return grid.filled(lambda y, v: peak(one, y, v) if free or possible(one, y, v) else np.inf)

    released = FAR * machine.plant.actuator.air_gap
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
        note="full current, but through the amplifier's lag and half a sample late: no law here can reach further",
    )
    return Recovery(**{**vars(data), "claims": (*claims, amplifier)})


def _claims(data: Recovery, law: str, machine: Machine) -> tuple[Claim, Claim]:
    gap, published = machine.plant.actuator.air_gap, law == PUBLISHED
    name = f"{law}," if published else f"{law}, |i_c| ≤ I0,"
    back = recovers(machine, FAR * gap)
    settled = settling_time(machine, data.releases[law][1]) * 1e3
    diverges = "it diverges (Fig. 4)"
    return (
        Claim(
            f"beyond Fig. 4: {name} recovers from 0.6 y0 (1 yes, 0 no)",
            0.0 if published else None,
            float(back),
            note=diverges if published else f"the paper: {diverges}; here within 1 % of y0 after {settled:.0f} ms",
        ),
        Claim(
            f"beyond Fig. 4: region of recovery, {law}, part of the physical limit",
            None,
            data.share(data.region(law)),
            note=f"at rest it recovers up to {largest_release(machine) / gap:.2f} y0; the stop is at "
            f"{machine.plant.platform.stop / gap:g} y0",
        ),
    )


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
    axes.plot(FAR, 0.0, "o", color=VERMILION, markersize=6)
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
