"""Fig. 3: relative error m_i of the current stiffness over position and current, by (4)."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import brentq

from straightcomp_ros.analysis.pictures import BLACK, BLUE, GREY, VERMILION
from straightcomp_ros.model.actuator import UNIT_GAIN_ERROR_LIMIT, stiffness_errors
from straightcomp_ros.tuning.paper.claims import Claim
from straightcomp_ros.tuning.paper.drawing import SMALL, label, sheet
from straightcomp_ros.tuning.paper.ideal_machine import Machine

TITLE = "Fig. 3: relative error $m_i$ of the current stiffness"
PAPER_LIMIT = 0.35
_SHOWN = 0.6
_CURRENTS = np.linspace(-1.0, 1.0, 401)


@dataclass(frozen=True, eq=False)
class GainError:
    """m_i (currents, positions) on a grid of i_c/I0 (currents,) and y/y0 (positions,); the limit of |y/y0|."""

    positions: NDArray[np.float64]
    currents: NDArray[np.float64]
    m_i: NDArray[np.float64]
    limit: float
    claims: tuple[Claim, ...]


def largest_gain_error(a: float) -> float:
    """Largest |m_i| over all |i_c| <= I0 at y/y0 = a."""
    return float(np.abs(stiffness_errors(a, _CURRENTS)[1]).max())  # type: ignore[arg-type]


def gain_error_limit() -> float:
    """|y/y0| up to which |m_i| <= 1 for all |i_c| <= I0, found from (4) itself."""
    return float(brentq(lambda a: largest_gain_error(a) - 1.0, 0.1, 0.9, xtol=1e-12))


def compute(machine: Machine) -> GainError:
    """m_i over the map of positions and currents; it depends on no parameter of the machine."""
    positions = np.linspace(-_SHOWN, _SHOWN, 481)
    a, b = np.meshgrid(positions, _CURRENTS)
    m_i = np.asarray(stiffness_errors(a, b)[1])  # type: ignore[arg-type]
    limit = gain_error_limit()
    claim = Claim(
        "Fig. 3: |y/y0| up to which |m_i| ≤ 1",
        PAPER_LIMIT,
        limit,
        "",
        tolerance=0.02,
        note=f"the paper reads its figure; the closed form (√3 − 1)/2 is {UNIT_GAIN_ERROR_LIMIT:.6f}",
    )
    sign = Claim(
        "Fig. 3: smallest gain 1 + m_i for |i_c| ≤ I0",
        None,
        float(1.0 + m_i.min()),
        "",
        note="above zero everywhere: |m_i| ≤ 1 is sufficient for the law's sign to be right, not necessary",
    )
    return GainError(positions, _CURRENTS, m_i, limit, (claim, sign))


def draw(data: GainError) -> Figure:
    """Contours of m_i, with the limit as found and as the paper reads it."""
    figure, (axes,) = sheet(TITLE, size=(8.0, 5.5))
    levels = [-0.05, 0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 3.0]
    widths = [1.8 if level == 1.0 else 0.8 for level in levels]
    contours = axes.contour(data.positions, data.currents, data.m_i, levels, colors=BLACK, linewidths=widths)
    axes.clabel(contours, fontsize=SMALL, fmt="%g", manual=_label_places(data, levels))
    axes.contourf(data.positions, data.currents, np.abs(data.m_i), [1.0, np.inf], colors=[GREY], alpha=0.5)
    for sign in (-1.0, 1.0):
        exact = f"±{data.limit:.4f}: |$m_i$| ≤ 1 for all currents" if sign > 0 else None
        printed = f"±{PAPER_LIMIT}: read by the paper" if sign > 0 else None
        axes.axvline(sign * data.limit, color=BLUE, linewidth=1.4, label=exact)
        axes.axvline(sign * PAPER_LIMIT, color=VERMILION, linewidth=1.4, linestyle="--", label=printed)
    label(
        axes,
        "grey: |$m_i$| > 1; dashed: −0.05; the two lines through the centre: 0",
        "position y/$y_0$ / 1",
        "control current $i_c$/$I_0$ / 1",
    )
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", fontsize=SMALL, ncols=2)
    return figure


def _label_places(data: GainError, levels: list[float]) -> list[tuple[float, float]]:
    """Where each contour crosses i_c/I0 = 0.5 right of the centre and −0.5 left of it; m_i is the same at both."""
    right = data.positions > 0.0
    row = data.m_i[np.argmin(np.abs(data.currents - 0.5)), right]
    places = [(float(np.interp(level, row, data.positions[right])), 0.5) for level in levels if level > 0.0]
    return [place for a, b in places if a < 0.58 for place in ((a, b), (-a, -b))]
