"""The error of the current stiffness by (4): Fig. 3, its map, and Fig. 4, release from where the gain is in doubt."""

import numpy as np
from scipy.optimize import brentq

from straightcomp_ros.analysis.pictures import label
from straightcomp_ros.analysis.style import BLACK, BLUE, GREY, VERMILION
from straightcomp_ros.model.actuator import UNIT_GAIN_ERROR_LIMIT, stiffness_errors
from straightcomp_ros.tuning.paper.figure import SMALL, Claim, PaperFigure, legend_below, sheet
from straightcomp_ros.tuning.paper.machine import Machine, Response, release

PAPER_LIMIT = 0.35
FAR = 0.6
"""y/y0 of the release."""
_SHOWN = 0.6
_CURRENTS = np.linspace(-1.0, 1.0, 401)
_DURATION = 0.12
_RETURNED = 0.01
"""|y/y0| at the end that counts as converged."""


def gain_error_limit() -> float:
    """|y/y0| up to which |m_i| <= 1 for all |i_c| <= I0, found from (4) itself."""
    return float(brentq(lambda a: np.abs(stiffness_errors(a, _CURRENTS)[1]).max() - 1.0, 0.1, 0.9, xtol=1e-12))


def gain_error(machine: Machine) -> PaperFigure:
    """Fig. 3: contours of m_i over positions and currents, with the limit as found and as the paper reads it.

    They depend on no parameter of the machine.
    """
    positions = np.linspace(-_SHOWN, _SHOWN, 481)
    m_i = np.asarray(stiffness_errors(*np.meshgrid(positions, _CURRENTS))[1])  # type: ignore[arg-type]
    limit = gain_error_limit()

    figure, (axes,) = sheet("Fig. 3: relative error $m_i$ of the current stiffness", "a", size=(8.0, 5.5))
    levels = [-0.05, 0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 3.0]
    widths = [1.8 if level == 1.0 else 0.8 for level in levels]
    contours = axes.contour(positions, _CURRENTS, m_i, levels, colors=BLACK, linewidths=widths)
    axes.clabel(contours, fontsize=SMALL, fmt="%g")
    axes.contourf(positions, _CURRENTS, np.abs(m_i), [1.0, np.inf], colors=[GREY], alpha=0.5)
    for sign in (-1.0, 1.0):
        exact = f"±{limit:.4f}: |$m_i$| ≤ 1 for all currents" if sign > 0 else None
        printed = f"±{PAPER_LIMIT}: read by the paper" if sign > 0 else None
        axes.axvline(sign * limit, color=BLUE, linewidth=1.4, label=exact)
        axes.axvline(sign * PAPER_LIMIT, color=VERMILION, linewidth=1.4, linestyle="--", label=printed)
    title = "grey: |$m_i$| > 1; dashed: −0.05; the two lines through the centre: 0"
    label(axes, title, "position y/$y_0$ / 1", "control current $i_c$/$I_0$ / 1")
    legend_below(figure, *axes.get_legend_handles_labels(), fontsize=SMALL, ncols=2)

    closed = f"the paper reads its figure; the closed form (√3 − 1)/2 is {UNIT_GAIN_ERROR_LIMIT:.6f}"
    sufficient = "above zero everywhere: |m_i| ≤ 1 is sufficient for the law's sign to be right, not necessary"
    claims = (
        Claim("Fig. 3: |y/y0| up to which |m_i| ≤ 1", limit, "", closed, PAPER_LIMIT, 0.02),
        Claim("Fig. 3: smallest gain 1 + m_i for |i_c| ≤ I0", float(1.0 + m_i.min()), "", sufficient),
    )
    return PaperFigure(claims, figure)


def released(machine: Machine, a: float) -> Response:
    """The release from y/y0 = a, with a reference of zero."""
    return release(machine, a * machine.gap, np.zeros(machine.samples(_DURATION)))


def far_release(machine: Machine) -> PaperFigure:
    """Fig. 4: release the idealised machine under (9), without and with a limit of the current.

    Position and current of both, over the first milliseconds and until the clamped law has settled.
    """
    free, gap, bias = machine.idealised().with_law("smc"), machine.gap, machine.bias
    unlimited, limited = (released(one, FAR) for one in (free, free.with_limit(bias)))

    figure, axes = sheet("Fig. 4: release from 0.6 $y_0$", "ab;cd", size=(9.0, 6.5))
    curves = (
        ("law (9), unclamped", unlimited, VERMILION, "-"),
        ("the same with |$i_c$| ≤ $I_0$", limited, BLUE, "--"),
    )
    for shown_ms, position, current in ((2.0, axes[0], axes[2]), (60.0, axes[1], axes[3])):
        for name, response, colour, style in curves:
            time = response.time * 1e3
            shown = time <= shown_ms
            position.plot(time[shown], response.y[shown] / gap, color=colour, linestyle=style, label=name)
            current.plot(time[shown], response.coil_current[shown] / bias, color=colour, linestyle=style, label=name)
        position.set_ylim(-0.15, 0.9)
        # Against the stop the integral only grows: the first part of it is enough.
        current.set_ylim(-12.0, 1.5)
        when = f"first {shown_ms:g} ms"
        label(position, f"Position, {when}", "time / ms", "position y/$y_0$ / 1")
        label(current, f"Current in the coils, {when}, cut off at −12", "time / ms", "control current $i_c$/$I_0$ / 1")
    axes[0].legend(loc="lower left", fontsize=SMALL)

    at_stop = np.flatnonzero(np.abs(unlimited.y) >= machine.stop)
    hit = f"against the stop after {unlimited.time[at_stop[0]] * 1e3:.1f} ms" if at_stop.size else "never at the stop"
    asks = f"it asks {abs(unlimited.command[0]) / bias:.1f} I0 at the release; {hit}"
    diverges = (float(abs(unlimited.y[-1]) > FAR * gap), float(abs(limited.y[-1]) >= _RETURNED * gap))
    unlike = "the divergence belongs to the unclamped law, not to the position"
    claims = (
        Claim("Fig. 4: from 0.6 y0 the unclamped law diverges (1 yes, 0 no)", diverges[0], "", asks, paper=1.0),
        Claim("Fig. 4: the same with |i_c| ≤ I0 diverges (1 yes, 0 no)", diverges[1], "", unlike),
    )
    return PaperFigure(claims, figure)
