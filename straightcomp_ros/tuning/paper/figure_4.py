"""Fig. 4: release from 0.6 y0, where the law's gain has the wrong sign."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from straightcomp_ros.analysis.pictures import BLUE, GREY, VERMILION
from straightcomp_ros.tuning.paper.claims import Claim, yes
from straightcomp_ros.tuning.paper.drawing import SMALL, label, sheet
from straightcomp_ros.tuning.paper.figure_3 import gain_error_limit
from straightcomp_ros.tuning.paper.ideal_machine import Machine
from straightcomp_ros.tuning.paper.release import Response, hold_still, largest, release

TITLE = "Fig. 4: release from 0.6 $y_0$"
RELEASED_AT = 0.6
"""y/y0."""
_DURATION = 0.12
_RETURNED = 0.01
"""|y/y0| at the end that counts as converged."""


@dataclass(frozen=True, eq=False)
class FarRelease:
    """The release with the law as it is, and with |i_c| limited to I0.

    Attributes:
        unclamped, clamped: the two responses.
        air_gap: y0, m.
        bias_current: I0, A.
        returns_from: largest y/y0 from which the unclamped law brings the platform back.
    """

    unclamped: Response
    clamped: Response
    air_gap: float
    bias_current: float
    returns_from: float
    claims: tuple[Claim, ...]


def returns(machine: Machine, a: float) -> bool:
    """Whether the platform, released at y/y0 = a, is back at the centre at the end."""
    gap = machine.plant.actuator.air_gap
    response = release(machine, a * gap, hold_still(machine, _DURATION))
    return bool(abs(response.y[-1]) < _RETURNED * gap)


def largest_release(machine: Machine, steps: int = 7) -> float:
    """Largest y/y0 from which the platform returns, by bisection from 0.1 to 0.6; to 0.4 % of y0 in 7 steps."""
    return largest(lambda a: returns(machine, a), 0.1, RELEASED_AT, steps)


def compute(machine: Machine) -> FarRelease:
    """Release the idealised machine under (9), without and with a limit of the current."""
    free = machine.idealised().with_law("smc")
    limited = free.with_limit(machine.plant.actuator.bias_current)
    gap = machine.plant.actuator.air_gap
    reference = hold_still(free, _DURATION)
    unclamped, clamped = (release(one, RELEASED_AT * gap, reference) for one in (free, limited))
    at_stop = np.flatnonzero(np.abs(unclamped.y) >= machine.plant.platform.stop)
    returns_from = largest_release(free)
    asked = abs(unclamped.command[0]) / machine.plant.actuator.bias_current
    hit = f"against the stop after {unclamped.time[at_stop[0]] * 1e3:.1f} ms" if at_stop.size else "never at the stop"
    claims = (
        Claim(
            "Fig. 4: from 0.6 y0 the unclamped law diverges (1 yes, 0 no)",
            1.0,
            yes(abs(unclamped.y[-1]) > RELEASED_AT * gap),
            "",
            note=f"it asks {asked:.1f} I0 at the release; {hit}",
        ),
        Claim(
            "Fig. 4: the same with |i_c| ≤ I0 diverges (1 yes, 0 no)",
            None,
            yes(abs(clamped.y[-1]) >= _RETURNED * gap),
            "",
            note="the divergence belongs to the unclamped law, not to the position",
        ),
        Claim(
            "Fig. 4: largest release from which the unclamped law returns, y/y0",
            None,
            returns_from,
            "",
            note=f"below the {gain_error_limit():.3f} of |m_i| ≤ 1, which holds for |i_c| ≤ I0 only: the law asks more",
        ),
    )
    return FarRelease(unclamped, clamped, gap, machine.plant.actuator.bias_current, returns_from, claims)


def draw(data: FarRelease) -> Figure:
    """Position and current of both releases, over the first milliseconds and until the clamped law has settled."""
    figure, axes = sheet(TITLE, rows=2, columns=2, size=(9.0, 6.5))
    curves = (
        ("law (9), unclamped", data.unclamped, VERMILION, "-"),
        ("the same with |$i_c$| ≤ $I_0$", data.clamped, BLUE, "--"),
    )
    for column, (shown_ms, when) in enumerate(((2.0, "first 2 ms"), (60.0, "first 60 ms"))):
        position, current = axes[column], axes[2 + column]
        for name, response, colour, style in curves:
            shown = response.time * 1e3 <= shown_ms
            time = response.time[shown] * 1e3
            y, i_c = response.y[shown] / data.air_gap, response.coil_current[shown] / data.bias_current
            position.plot(time, y, color=colour, linestyle=style, label=name)
            current.plot(time, i_c, color=colour, linestyle=style, label=name)
        text = f"{data.returns_from:.2f}: unclamped law returns from below"
        position.axhline(data.returns_from, color=GREY, linewidth=1.2, linestyle=":", label=text)
        position.set_ylim(-0.15, 0.9)
        # Against the stop the integral only grows: the first part of it tells the tale.
        current.set_ylim(-12.0, 1.5)
        label(position, f"Position, {when}", "time / ms", "position y/$y_0$ / 1")
        label(current, f"Current in the coils, {when}, cut off at −12", "time / ms", "control current $i_c$/$I_0$ / 1")
    axes[0].legend(loc="lower left", fontsize=SMALL)
    return figure
