"""One run along the guide: deviation over x, measured in one direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.straightness.survey_columns import SurveyError

Direction = Literal["forward", "backward"]


@dataclass(frozen=True, eq=False)
class Run:
    """One run, x ascending whichever way the stage moved.

    Attributes:
        name: the run's label in its file.
        direction: ``forward`` when the stage moved towards larger x.
        x: (n,) slider position in m, strictly ascending.
        deviation: (n,) deviation of the guide in m at x.
    """

    name: str
    direction: Direction
    x: NDArray[np.float64]
    deviation: NDArray[np.float64]


def orient(
    where: str,
    name: str,
    direction: Direction | None,
    lines: Sequence[int],
    x: Sequence[float],
    deviation: Sequence[float],
) -> Run:
    """A run from its rows in the order of the file; ``where`` opens the messages, ``lines`` are line numbers.

    A backward run may be listed as it was driven or sorted by x. A forward run with falling x
    contradicts itself and is refused. Without ``direction``, the trend of x tells it.

    Args:
        x, deviation: in m, at least two values each.

    Raises:
        SurveyError: x does not go one way, or contradicts ``direction``.
    """
    steps = np.diff(x)
    rising = x[-1] > x[0] if x[-1] != x[0] else bool(steps[0] > 0.0)
    wrong = np.flatnonzero(steps <= 0.0 if rising else steps >= 0.0)
    if wrong.size:
        at = int(wrong[0]) + 1
        fault = "repeats" if x[at] == x[at - 1] else "turns back"
        raise SurveyError(
            f"{where}, line {lines[at]}: x {fault}: {x[at] * 1e3:.10g} mm after {x[at - 1] * 1e3:.10g} mm "
            f"(line {lines[at - 1]}); allowed: x that only {'rises' if rising else 'falls'} within a run"
        )
    if direction == "forward" and not rising:
        raise SurveyError(
            f"{where}, line {lines[1]}: direction is 'forward' but x falls to {x[1] * 1e3:.10g} mm; "
            "allowed: x that rises, or direction 'backward'"
        )
    order = slice(None) if rising else slice(None, None, -1)
    return Run(
        name,
        direction or ("forward" if rising else "backward"),
        _frozen(np.array(x, dtype=np.float64)[order]),
        _frozen(np.array(deviation, dtype=np.float64)[order]),
    )


def check_gaps(where: str, run: Run, max_gap: float) -> None:
    """Refuse a run with neighbouring points farther apart than ``max_gap`` in m.

    Raises:
        SurveyError: with the place of the widest gap.
    """
    steps = np.diff(run.x)
    widest = int(np.argmax(steps))
    # A nanometre of grace: 0.05 m steps read from decimal text differ in the last bit.
    if steps[widest] > max_gap + 1e-9:
        raise SurveyError(
            f"{where}: no point between x = {run.x[widest] * 1e3:.10g} mm and {run.x[widest + 1] * 1e3:.10g} mm, "
            f"a gap of {steps[widest] * 1e3:.6g} mm; allowed: <= {max_gap * 1e3:.6g} mm (max_gap)"
        )


def _frozen(values: NDArray[np.float64]) -> NDArray[np.float64]:
    values.setflags(write=False)
    return values
