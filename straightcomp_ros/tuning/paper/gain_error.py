"""The error of the current stiffness by (4): Fig. 3, its map, and Fig. 4, release from where the gain is in doubt."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import brentq

from straightcomp_ros.analysis.pictures import BLACK, BLUE, GREY, VERMILION
from straightcomp_ros.model.actuator import UNIT_GAIN_ERROR_LIMIT, stiffness_errors
from straightcomp_ros.tuning.paper.figure import SMALL, Claim, label, sheet
from straightcomp_ros.tuning.paper.machine import Machine, Response, hold_still, largest, release

PAPER_LIMIT = 0.35
FAR = 0.6
"""y/y0 of the release."""
_SHOWN = 0.6
_CURRENTS = np.linspace(-1.0, 1.0, 401)
_DURATION = 0.12
_RETURNED = 0.01
"""|y/y0| at the end that counts as converged."""


@dataclass(frozen=True, eq=False)
class GainError:
    """m_i (currents, positions) on a grid of i_c/I0 (currents,) and y/y0 (positions,); the limit of |y/y0|."""

    positions: NDArray[np.float64]
    currents: NDArray[np.float64]
    m_i: NDArray[np.float64]
    limit: float
    claims: tuple[Claim, ...]

    def draw(self) -> Figure:
        """Contours of m_i, with the limit as found and as the paper reads it."""
        figure, (axes,) = sheet("Fig. 3: relative error $m_i$ of the current stiffness", size=(8.0, 5.5))
        levels = [-0.05, 0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 3.0]
        widths = [1.8 if level == 1.0 else 0.8 for level in levels]
        contours = axes.contour(self.positions, self.currents, self.m_i, levels, colors=BLACK, linewidths=widths)
        axes.clabel(contours, fontsize=SMALL, fmt="%g", manual=_label_places(self, levels))
        axes.contourf(self.positions, self.currents, np.abs(self.m_i), [1.0, np.inf], colors=[GREY], alpha=0.5)
        for sign in (-1.0, 1.0):
            exact = f"±{self.limit:.4f}: |$m_i$| ≤ 1 for all currents" if sign > 0 else None
            printed = f"±{PAPER_LIMIT}: read by the paper" if sign > 0 else None
            axes.axvline(sign * self.limit, color=BLUE, linewidth=1.4, label=exact)
            axes.axvline(sign * PAPER_LIMIT, color=VERMILION, linewidth=1.4, linestyle="--", label=printed)
        label(
            axes,
            "grey: |$m_i$| > 1; dashed: −0.05; the two lines through the centre: 0",
            "position y/$y_0$ / 1",
            "control current $i_c$/$I_0$ / 1",
        )
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", fontsize=SMALL, ncols=2)
        return figure


def largest_gain_error(a: float) -> float:
    """Largest |m_i| over all |i_c| <= I0 at y/y0 = a."""
    return float(np.abs(stiffness_errors(a, _CURRENTS)[1]).max())  # type: ignore[arg-type]


def gain_error_limit() -> float:
    """|y/y0| up to which |m_i| <= 1 for all |i_c| <= I0, found from (4) itself."""
    return float(brentq(lambda a: largest_gain_error(a) - 1.0, 0.1, 0.9, xtol=1e-12))


def gain_error(machine: Machine) -> GainError:
    """m_i over the map of positions and currents; it depends on no parameter of the machine."""
    positions = np.linspace(-_SHOWN, _SHOWN, 481)
    a, b = np.meshgrid(positions, _CURRENTS)
    m_i = np.asarray(stiffness_errors(a, b)[1])  # type: ignore[arg-type]
    limit = gain_error_limit()
    claim = Claim(
        "Fig. 3: |y/y0| up to which |m_i| ≤ 1",
        PAPER_LIMIT,
        limit,
        tolerance=0.02,
        note=f"the paper reads its figure; the closed form (√3 − 1)/2 is {UNIT_GAIN_ERROR_LIMIT:.6f}",
    )
    sign = Claim(
        "Fig. 3: smallest gain 1 + m_i for |i_c| ≤ I0",
        None,
        float(1.0 + m_i.min()),
        note="above zero everywhere: |m_i| ≤ 1 is sufficient for the law's sign to be right, not necessary",
    )
    return GainError(positions, _CURRENTS, m_i, limit, (claim, sign))


def _label_places(data: GainError, levels: list[float]) -> list[tuple[float, float]]:
    """Where each contour crosses i_c/I0 = 0.5 right of the centre and −0.5 left of it; m_i is the same at both."""
    right = data.positions > 0.0
    row = data.m_i[np.argmin(np.abs(data.currents - 0.5)), right]
    places = [(float(np.interp(level, row, data.positions[right])), 0.5) for level in levels if level > 0.0]
    return [place for a, b in places if a < 0.58 for place in ((a, b), (-a, -b))]


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

    def draw(self) -> Figure:
        """Position and current of both releases, over the first milliseconds and until the clamped law has settled."""
        figure, axes = sheet("Fig. 4: release from 0.6 $y_0$", rows=2, columns=2, size=(9.0, 6.5))
        curves = (
            ("law (9), unclamped", self.unclamped, VERMILION, "-"),
            ("the same with |$i_c$| ≤ $I_0$", self.clamped, BLUE, "--"),
        )
        for column, (shown_ms, when) in enumerate(((2.0, "first 2 ms"), (60.0, "first 60 ms"))):
            position, current = axes[column], axes[2 + column]
            for name, response, colour, style in curves:
                shown = response.time * 1e3 <= shown_ms
                time = response.time[shown] * 1e3
                y, i_c = response.y[shown] / self.air_gap, response.coil_current[shown] / self.bias_current
                position.plot(time, y, color=colour, linestyle=style, label=name)
                current.plot(time, i_c, color=colour, linestyle=style, label=name)
            text = f"{self.returns_from:.2f}: unclamped law returns from below"
            position.axhline(self.returns_from, color=GREY, linewidth=1.2, linestyle=":", label=text)
            position.set_ylim(-0.15, 0.9)
            # Against the stop the integral only grows: the first part of it is enough.
            current.set_ylim(-12.0, 1.5)
            label(position, f"Position, {when}", "time / ms", "position y/$y_0$ / 1")
            label(
                current, f"Current in the coils, {when}, cut off at −12", "time / ms", "control current $i_c$/$I_0$ / 1"
            )
        axes[0].legend(loc="lower left", fontsize=SMALL)
        return figure


def returns(machine: Machine, a: float) -> bool:
    """Whether the platform, released at y/y0 = a, is back at the centre at the end."""
    gap = machine.plant.actuator.air_gap
    response = release(machine, a * gap, hold_still(machine, _DURATION))
    return bool(abs(response.y[-1]) < _RETURNED * gap)


def largest_release(machine: Machine, steps: int = 7) -> float:
    """Largest y/y0 from which the platform returns, by bisection from 0.1 to 0.6; to 0.4 % of y0 in 7 steps."""
    return largest(lambda a: returns(machine, a), 0.1, FAR, steps)


def far_release(machine: Machine) -> FarRelease:
    """Release the idealised machine under (9), without and with a limit of the current."""
    free = machine.idealised().with_law("smc")
    limited = free.with_limit(machine.plant.actuator.bias_current)
    gap = machine.plant.actuator.air_gap
    reference = hold_still(free, _DURATION)
    unclamped, clamped = (release(one, FAR * gap, reference) for one in (free, limited))
    at_stop = np.flatnonzero(np.abs(unclamped.y) >= machine.plant.platform.stop)
    returns_from = largest_release(free)
    asked = abs(unclamped.command[0]) / machine.plant.actuator.bias_current
    hit = f"against the stop after {unclamped.time[at_stop[0]] * 1e3:.1f} ms" if at_stop.size else "never at the stop"
    claims = (
        Claim(
            "Fig. 4: from 0.6 y0 the unclamped law diverges (1 yes, 0 no)",
            1.0,
            float(abs(unclamped.y[-1]) > FAR * gap),
            note=f"it asks {asked:.1f} I0 at the release; {hit}",
        ),
        Claim(
            "Fig. 4: the same with |i_c| ≤ I0 diverges (1 yes, 0 no)",
            None,
            float(abs(clamped.y[-1]) >= _RETURNED * gap),
            note="the divergence belongs to the unclamped law, not to the position",
        ),
        Claim(
            "Fig. 4: largest release from which the unclamped law returns, y/y0",
            None,
            returns_from,
            note=f"below the {gain_error_limit():.3f} of |m_i| ≤ 1, which holds for |i_c| ≤ I0 only: the law asks more",
        ),
    )
    return FarRelease(unclamped, clamped, gap, machine.plant.actuator.bias_current, returns_from, claims)
