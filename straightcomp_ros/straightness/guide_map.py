"""The map of the guide: where the platform must be for each slider position, r(x) = const − δ(x)."""

from __future__ import annotations

from bisect import bisect_right
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from straightcomp_ros.settings.declaration import parameter
from straightcomp_ros.settings.share import share_path
from straightcomp_ros.straightness.mean import mean_of_directions, on_common_grid, report
from straightcomp_ros.straightness.runout import Runout, runout
from straightcomp_ros.straightness.spline import cubic_spline
from straightcomp_ros.straightness.survey import Survey, SurveyError, read_survey

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


@dataclass(frozen=True)
class MapParameters:
    """Where the survey is and what is asked of it."""

    file: str = parameter(
        "config/survey_synthetic.csv",
        "Survey file; a relative name is looked up in the working directory, then in the package's share",
    )
    min_points: int = parameter(20, "Fewest points that a run of the survey may have", minimum=4, maximum=1_000_000)
    max_gap: float = parameter(0.05, "Widest distance between neighbouring points", unit="m", above=0.0, maximum=1.0)
    travel: float = parameter(100e-6, "Usable travel of the platform, to each side", unit="m", above=0.0, maximum=1e-2)
    runout: float = parameter(
        0.02,
        "Length beyond the survey over which the reference runs out to a constant",
        unit="m",
        above=0.0,
        maximum=1.0,
    )


class StraightnessMap:
    """r(x) with two continuous derivatives, from a cubic spline through the mean of a survey's runs.

    The spline has not-a-knot ends. r is centred: over the survey its largest and smallest value are opposite.
    Beyond the survey r runs out to a constant (see :mod:`straightcomp_ros.straightness.runout`). No line is
    removed: the workpiece moves straight along the line that the survey was measured against.

    A lookup takes no NumPy: at 2 kHz its overhead on single numbers would be the largest part.

    Attributes:
        report: agreement of the runs, lengths in m.
        span: first and last x of the survey in m.
        offset: the constant in r(x) = offset − δ(x), in m.
    """

    def __init__(self, survey: Survey, parameters: MapParameters = MapParameters()) -> None:
        """Build the map.

        Raises:
            SurveyError: the runs do not fit together, or the correction exceeds the platform's travel.
        """
        x, values = on_common_grid(survey, min_points=parameters.min_points, max_gap=parameters.max_gap)
        self.report = report(survey, values)
        self.span = (float(x[0]), float(x[-1]))
        spline = cubic_spline(x, mean_of_directions(survey, values))
        turns = spline.derivative().roots(extrapolate=False)
        extremes = np.concatenate([spline(x), spline(turns[np.isfinite(turns)])])
        self.offset = float(extremes.max() + extremes.min()) / 2.0

        low = runout(*_end_state(spline, x[0], -1.0, self.offset), parameters.runout)
        high = runout(*_end_state(spline, x[-1], 1.0, self.offset), parameters.runout)
        largest = max(
            float(np.ptp(extremes)) / 2.0, *(abs(value) for end in (low, high) for value in (end.held, end.turning))
        )
        if largest > parameters.travel:
            raise SurveyError(
                f"survey {survey.source}: the correction reaches {largest * 1e6:.4g} µm to each side; "
                f"allowed: <= {parameters.travel * 1e6:.4g} µm (travel)"
            )
        self._breaks: tuple[float, ...] = tuple(
            [self.span[0] - parameters.runout, *x.tolist(), self.span[1] + parameters.runout]
        )
        self._pieces = _pieces(spline, self.offset, self._breaks, low, high)
        self._tables = (np.array(self._breaks), np.array(self._pieces).T)

    def reference(self, x: float) -> tuple[float, float, float]:
        """r in m, dr/dx in m/m and d²r/dx² in 1/m at x in m; NaN for NaN."""
        origin, c0, c1, c2, c3, c4 = self._pieces[bisect_right(self._breaks, x)]
        t = x - origin
        return (
            c0 + t * (c1 + t * (c2 + t * (c3 + t * c4))),
            c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4))),
            2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4)),
        )

    def deviation(self, x: float) -> float:
        """δ in m at x in m: what the survey says of the guide."""
        origin, c0, c1, c2, c3, c4 = self._pieces[bisect_right(self._breaks, x)]
        t = x - origin
        return self.offset - (c0 + t * (c1 + t * (c2 + t * (c3 + t * c4))))

    def evaluate(self, x: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """:meth:`reference` for an array: three arrays of the shape of ``x``, the same to the last bit."""
        positions = np.asarray(x, dtype=np.float64)
        breaks, pieces = self._tables
        origin, c0, c1, c2, c3, c4 = pieces[:, np.searchsorted(breaks, positions, side="right")]
        t = positions - origin
        # The order of operations of reference(): float64 then gives the same bits.
        return (
            c0 + t * (c1 + t * (c2 + t * (c3 + t * c4))),
            c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4))),
            2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4)),
        )

    def deviations(self, x: ArrayLike) -> NDArray[np.float64]:
        """:meth:`deviation` for an array."""
        return self.offset - self.evaluate(x)[0]


def load_map(parameters: MapParameters = MapParameters()) -> StraightnessMap:
    """Read the survey that ``parameters`` name and build its map.

    Raises:
        SurveyError: the file is not found or refused.
    """
    survey = read_survey(find_survey(parameters.file), min_points=parameters.min_points, max_gap=parameters.max_gap)
    return StraightnessMap(survey, parameters)


def find_survey(name: str) -> Path:
    """Full path of a survey: as it is if absolute, else from the working directory, else from the package's share.

    Raises:
        SurveyError: in none of these places.
    """
    path = Path(name)
    if path.is_file():
        return path.resolve()
    if path.exists():
        raise SurveyError(f"survey {name}: is no file; name a CSV file")
    if not path.is_absolute():
        with suppress(FileNotFoundError):
            return share_path(name)
    beside = "" if path.is_absolute() else f" in the working directory {Path.cwd()}, nor among the package's own files"
    raise SurveyError(f"survey {name}: there is no such file{beside}")


def _end_state(spline: CubicSpline, x: float, outward: float, offset: float) -> tuple[float, float, float]:
    """Value, slope and curvature of r at an end, the slope counted outward."""
    return offset - float(spline(x)), -outward * float(spline(x, 1)), -float(spline(x, 2))


def _pieces(
    spline: CubicSpline, offset: float, breaks: tuple[float, ...], low: Runout, high: Runout
) -> tuple[tuple[float, ...], ...]:
    """For each interval between ``breaks``, and beyond: origin and polynomial coefficients, constant first.

    One more than there are breaks: piece i holds where i breaks are at or below x.
    """
    first, last = breaks[1], breaks[-2]
    mirrored = [c if power % 2 == 0 else -c for power, c in enumerate(low.coefficients)]
    inner = [
        (origin, offset - c0, -c1, -c2, -c3, 0.0)
        for origin, (c3, c2, c1, c0) in zip(breaks[1:-2], spline.c.T.tolist(), strict=True)
    ]
    return (
        (breaks[0], low.held, 0.0, 0.0, 0.0, 0.0),
        (first, *mirrored),
        *inner,
        (last, *high.coefficients),
        (breaks[-1], high.held, 0.0, 0.0, 0.0, 0.0),
    )
