"""Mean and repeatability of a survey's runs in the way of ISO 230-2:2014, which defines repeatability for positioning.

At each point i, over the n runs of one direction: the mean, and the estimator s_i of the standard uncertainty, the
sample standard deviation (divisor n − 1). From these, with the coverage factor 2 of the standard,

    unidirectional repeatability  R_i↑ = 4 s_i↑,  R_i↓ = 4 s_i↓
    reversal value                B_i = mean_i↑ − mean_i↓
    bidirectional repeatability   R_i = max(2 s_i↑ + 2 s_i↓ + |B_i|, R_i↑, R_i↓)

and of each the largest over the points is the figure of the axis. Here the deviation across the motion takes the place
of the one along it. The standard asks for five runs each way; fewer make the figures less certain. Offsets between runs
count: nothing is removed from a run before.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.survey import Survey

_RECOMMENDED = 5


@dataclass(frozen=True, eq=False)
class Directed:
    """One direction: ``runs``, and over the points (n,) in m ``mean`` and ``s`` (None for a single run)."""

    runs: int
    mean: NDArray[np.float64]
    s: NDArray[np.float64] | None

    @property
    def repeatability(self) -> float | None:
        """R↑ or R↓ in m."""
        return None if self.s is None else 4.0 * float(self.s.max())


@dataclass(frozen=True, eq=False)
class Repeatability:
    """How well the runs of a survey agree.

    Attributes:
        x: (n,) points in m.
        forward, backward: None for a direction that was not driven.
    """

    x: NDArray[np.float64]
    forward: Directed | None
    backward: Directed | None

    @property
    def mean(self) -> NDArray[np.float64]:
        """Mean (n,) in m of the forward mean and the backward mean, whatever the number of runs of each."""
        return np.asarray(np.mean([one.mean for one in (self.forward, self.backward) if one is not None], axis=0))

    @property
    def reversal(self) -> NDArray[np.float64] | None:
        """B_i (n,) in m; None without both directions."""
        if self.forward is None or self.backward is None:
            return None
        return np.asarray(self.forward.mean - self.backward.mean)

    @property
    def bidirectional(self) -> float | None:
        """R in m; None unless both directions have two runs."""
        if self.forward is None or self.backward is None or self.forward.s is None or self.backward.s is None:
            return None
        ahead, back = self.forward.s, self.backward.s
        both = 2.0 * ahead + 2.0 * back + np.abs(self.forward.mean - self.backward.mean)
        return float(np.max([both, 4.0 * ahead, 4.0 * back]))

    @property
    def short_of_the_standard(self) -> bool:
        """True when a direction has fewer than the five runs of ISO 230-2."""
        return any(one is None or one.runs < _RECOMMENDED for one in (self.forward, self.backward))

    def __str__(self) -> str:
        runs = [one.runs if one else 0 for one in (self.forward, self.backward)]
        text = f"{len(self.x)} points, {runs[0]} forward and {runs[1]} backward runs"
        text += f", {peak_to_peak(self.mean) * 1e6:.2f} µm peak to peak"
        spreads = [float(one.s.max()) for one in (self.forward, self.backward) if one and one.s is not None]
        if spreads:
            text += f", standard deviation at most {max(spreads) * 1e6:.3f} µm"
        if self.reversal is not None:
            text += f", hysteresis {float(np.abs(self.reversal).max()) * 1e6:.3f} µm"
        return text

    def to_display(self) -> dict[str, float | None]:
        """The figures as a person reads them: lengths in µm."""
        reversal = self.reversal
        figures = {
            "repeatability_forward": self.forward.repeatability if self.forward else None,
            "repeatability_backward": self.backward.repeatability if self.backward else None,
            "repeatability_bidirectional": self.bidirectional,
            "reversal_max": None if reversal is None else float(np.abs(reversal).max()),
            "reversal_mean": None if reversal is None else float(reversal.mean()),
        }
        return {f"{name}_um": None if value is None else value * 1e6 for name, value in figures.items()}


def repeatability(survey: Survey, x: NDArray[np.float64], values: NDArray[np.float64]) -> Repeatability:
    """The figures of a survey at ``x`` (n,) in m, with ``values`` (runs, n) in m, both of
    :func:`straightcomp_ros.straightness.common_grid.on_common_grid`."""

    def directed(direction: str) -> Directed | None:
        chosen = values[[run.direction == direction for run in survey.runs]]
        if not len(chosen):
            return None
        return Directed(len(chosen), chosen.mean(axis=0), chosen.std(axis=0, ddof=1) if len(chosen) > 1 else None)

    return Repeatability(x, directed("forward"), directed("backward"))
