"""The map of the guide: where the platform must be for each slider position, r(x) = const − δ(x)."""

import os
from bisect import bisect_right
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from straightcomp_ros.parameters.declaration import RefusedParameter, parameter
from straightcomp_ros.parameters.share import named_file
from straightcomp_ros.straightness.hysteresis import half_difference
from straightcomp_ros.straightness.smoothing import smoothed
from straightcomp_ros.straightness.survey import Survey, read_survey
from straightcomp_ros.straightness.survey_header import WAYS, Direction, SurveyError
from straightcomp_ros.straightness.survey_runs import cubic_spline, on_common_grid, repeatability

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

T = TypeVar("T", float, NDArray[np.float64])

LARGEST_FACTOR = 1e6
"""Of the smoothing; its sixth root, 10, is the factor of the shortest wave that is left."""


@dataclass(frozen=True)
class MapParameters:
    """The survey of the guide, and the requirements on it."""

    file: str = parameter(
        "config/survey_synthetic.csv",
        "Survey file; a relative name is of the stage file's folder, the working directory or the package's share",
    )
    min_points: int = parameter(20, "Fewest points that a run of the survey may have", "[4, 1e6]")
    max_gap: float = parameter(0.05, "Widest distance between neighbouring points", "(0, 1] m")
    travel: float = parameter(100e-6, "Usable travel of the platform, to each side", "(0, 0.01] m")
    runout: float = parameter(
        0.02, "Length beyond the survey over which the reference runs out to a constant", "[1e-6, 1] m"
    )
    smooth: str = parameter(
        "auto",
        "Smoothing of the survey: auto takes off its noise as the runs show it, none leaves every point as measured, "
        "a number >= 0 multiplies the amount of auto",
    )
    direction: str = parameter(
        "auto",
        "Tables of the map: auto makes one for each direction of travel where the survey's hysteresis is more than its "
        "noise, mean always makes one, the mean of both directions, and both always makes two",
        choices=("auto", "mean", "both"),
    )
    reversal: float = parameter(
        0.002,
        "Travel after a reversal over which the reference goes from one direction's table to the other's",
        "(0, 1] m",
    )
    reference: str = parameter(
        "",
        "Encoder's reference that x of the machine is counted from, in the words of the survey's line `# encoder "
        "reference: …`; empty: not known",
    )

    def __post_init__(self) -> None:
        if self.smooth not in ("auto", "none"):
            with suppress(ValueError):
                if 0.0 <= float(self.smooth) <= LARGEST_FACTOR:
                    return
            raise RefusedParameter(
                "smooth", f"{self.smooth!r}; allowed: auto, none or a number from 0 to {LARGEST_FACTOR:g}"
            )


class StraightnessMap:
    """r(x) with two continuous derivatives, from a cubic spline through the mean of a survey's runs.

    The spline has not-a-knot ends. Where the runs show noise that hides the guide, it is one that smooths their mean,
    see :mod:`~straightcomp_ros.straightness.smoothing`. r is centred: over the survey its largest and smallest value
    are opposite. Beyond the survey r runs out to a constant, see :func:`runout`. No line is removed: the workpiece
    moves straight along the line that the survey was measured against.

    Where the guide's hysteresis is more than the survey's noise (:mod:`~straightcomp_ros.straightness.hysteresis`), the
    map has a table for each direction of travel, and their mean is what is described above;
    :mod:`~straightcomp_ros.straightness.feedforward` goes from one to the other.

    Attributes:
        survey: that it was built from.
        report: agreement of the runs.
        noise: what the survey's noise leaves in the map, of two tables in each.
        directed: whether there are two tables.
        reversal: travel in m after a reversal from one to the other.
        span: first and last x of the survey in m.
        offset: the constant in r(x) = offset − δ(x), in m.
        largest: |r| in m, where it runs out too.
        reference: gives r in m, dr/dx in m/m and d²r/dx² in 1/m at x in m; NaN for NaN; of two tables the mean.

    Raises:
        SurveyError: the runs do not fit together, or the correction exceeds the platform's travel.
    """

    def __init__(self, survey: Survey, parameters: MapParameters = MapParameters()) -> None:
        self.survey = survey
        x, values = on_common_grid(survey, parameters.min_points, parameters.max_gap)
        self._described = parameters.reference
        self.report = repeatability(survey, x, values)
        self.span = (float(x[0]), float(x[-1]))
        mean, self.reversal = self.report.mean, parameters.reversal
        spline, self.noise = smoothed(survey, x, values, mean, parameters.smooth)
        half = None
        if parameters.direction != "mean":
            always = parameters.direction == "both"
            half = half_difference(survey, x, values, mean, self.noise, parameters.smooth, always)
        if spline is None:
            spline = cubic_spline(x, mean)
        turns = spline.derivative().roots(extrapolate=False)
        extremes = np.concatenate([spline(spline.x), spline(turns[np.isfinite(turns)])])
        self.offset = float(extremes.max() + extremes.min()) / 2.0
        self._mean = _Curve(spline, self.offset, parameters.runout)
        self.reference = self._mean.at
        within = float(np.ptp(extremes)) / 2.0
        self.largest = max(within, self._mean.largest_beyond)
        self._half: _Curve | None = None
        if half is not None:
            self._half, self.noise = _Curve(half[0], 0.0, parameters.runout), half[1]
            within += (apart := float(np.abs(half[0](x)).max()))
            self.largest += max(apart, self._half.largest_beyond)
        self.directed = self._half is not None
        if self.largest > parameters.travel:
            # A run-out as long as a short guide goes far beyond it.
            beyond = f" where it runs out over {parameters.runout * 1e3:.4g} mm (runout)"
            where = beyond if within <= parameters.travel else ""
            raise SurveyError(
                f"survey {survey.source}: the correction reaches {self.largest * 1e6:.4g} µm to each side{where}; "
                f"allowed: <= {parameters.travel * 1e6:.4g} µm (travel)"
            )

    def __str__(self) -> str:
        tables = f"; two tables, up to {self.hysteresis * 1e6:.2g} µm apart" if self.directed else ""
        return "; ".join(filter(None, (str(self.report), f"{self.noise}{tables}", self.mismatch())))

    def mismatch(self) -> str:
        """What is wrong where the description's x is counted from another reference of the encoder than the survey's;
        empty where they agree, or one is not known."""
        mark, described = self.survey.mark, self._described
        if not (mark and described) or mark == described:
            return ""
        return (
            f"survey {self.survey.source}: x is counted from {mark!r}, the machine's from {described!r}: the map is "
            "shifted; straightcomp map align finds by how much"
        )

    @property
    def hysteresis(self) -> float:
        """Largest distance in m of the tables at the survey's points; 0 for one table."""
        return 0.0 if self._half is None else 2.0 * float(np.abs(self._half.over(self.report.x)[0]).max())

    @cached_property
    def steepest(self) -> float:
        """Largest |dr/dx| of all tables at the survey's points and in the middle between them."""
        points = self.report.x
        x = np.concatenate([points, 0.5 * (points[1:] + points[:-1])])
        return max(float(np.abs(self.evaluate(x, way)[1]).max()) for way in WAYS)

    def tables(self, x: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """:attr:`reference` of the forward and of the backward table, where there are two."""
        assert self._half is not None
        (r, slope, curvature), (d, d_slope, d_curvature) = self._mean.at(x), self._half.at(x)
        return (r + d, slope + d_slope, curvature + d_curvature), (r - d, slope - d_slope, curvature - d_curvature)

    def table(self) -> str:
        """The map at the survey's points as CSV: x, r or r forward and backward, and the standard deviation that the
        survey's noise leaves in it."""
        x = self.report.x
        columns = {"x_mm": x * 1e3, "r_um": self.evaluate(x)[0] * 1e6, "s_um": self.noise.band(x) * 1e6}
        if self.directed:
            columns |= {f"r_{way}_um": self.evaluate(x, way)[0] * 1e6 for way in WAYS}
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        return "\n".join([",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in rows)]) + "\n"

    def evaluate(
        self, x: ArrayLike, direction: Direction | NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """:attr:`reference` for an array, or that of the table for ``direction`` (an array: 1 forward, -1 backward):
        three arrays of the shape of ``x``, the same to the last bit."""
        positions = np.asarray(x, dtype=np.float64)
        mean = self._mean.over(positions)
        if self._half is None or direction is None:
            return mean
        sign = {"forward": 1.0, "backward": -1.0}[direction] if isinstance(direction, str) else direction
        r, slope, curvature = (of + sign * half for of, half in zip(mean, self._half.over(positions), strict=True))
        return r, slope, curvature

    def deviations(self, x: ArrayLike, direction: Direction | NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """δ in m at x in m: the guide's deviation by the survey; of two tables the mean, or that for ``direction``."""
        return self.offset - self.evaluate(x, direction)[0]


class _Curve:
    """offset − spline over the spline's range, beyond it a :func:`runout` of the length ``runout``, all in m;
    ``largest_beyond`` is the largest value of that, as a distance from 0."""

    def __init__(self, spline: "PPoly", offset: float, length: float) -> None:
        first, last = float(spline.x[0]), float(spline.x[-1])
        # Value, slope and curvature of r at each end, the slope outward.
        (into, low, *low_turn), (beyond, high, *high_turn) = (
            runout(offset - float(spline(end)), -outward * float(spline(end, 1)), -float(spline(end, 2)), length)
            for end, outward in ((first, -1.0), (last, 1.0))
        )
        self.largest_beyond = max(*map(abs, (low, high, *low_turn, *high_turn)))
        # Piece i is origin and polynomial coefficients, constant first; it holds where i breaks are at or below x.
        breaks = [first - length, *spline.x.tolist(), last + length]
        pieces = [
            (breaks[0], low, 0.0, 0.0, 0.0, 0.0),
            (first, *(c if power % 2 == 0 else -c for power, c in enumerate(into))),
            *(
                (start, offset - c0, -c1, -c2, -c3, 0.0)
                for start, (c3, c2, c1, c0) in zip(breaks[1:-2], spline.c.T.tolist(), strict=True)
            ),
            (last, *beyond),
            (breaks[-1], high, 0.0, 0.0, 0.0, 0.0),
        ]
        self._breaks, self._pieces = tuple(breaks), tuple(pieces)
        self._tables = (np.array(breaks), np.array(pieces).T)

    def at(self, x: float) -> tuple[float, float, float]:
        # Without NumPy, whose overhead on single numbers would be the largest part at 2 kHz.
        return _polynomial(x, *self._pieces[bisect_right(self._breaks, x)])

    def over(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        breaks, pieces = self._tables
        return _polynomial(x, *pieces[:, np.searchsorted(breaks, x, side="right")])


def load_map(parameters: MapParameters = MapParameters()) -> StraightnessMap:
    """The map of the survey that ``parameters`` name; SurveyError if it is not found or refused."""
    return map_of(load_survey(parameters), parameters)


# Strokes of one stage ask for one map again and again, which takes as long as to compute the stroke.
@lru_cache(maxsize=8)
def map_of(survey: Survey, parameters: MapParameters) -> StraightnessMap:
    """The map of a survey, made once; SurveyError as of :class:`StraightnessMap`."""
    return StraightnessMap(survey, parameters)


def load_survey(parameters: MapParameters) -> Survey:
    """The survey that ``parameters`` name; SurveyError if it is not found or refused."""
    return read_survey(find_survey(parameters.file), min_points=parameters.min_points, max_gap=parameters.max_gap)


def find_survey(name: str) -> Path:
    """Full path of a survey: as it is if absolute, else from the working directory, else from the package's share.

    Raises:
        SurveyError: in none of these places.
    """
    path = named_file(name)
    if os.path.isfile(path):
        return path.resolve()
    if os.path.exists(path):
        raise SurveyError(f"survey {name}: is no file; name a CSV file")
    where = (
        f" in the working directory {Path.cwd()}, the folder of a stage file that names it, or the package's own files"
    )
    raise SurveyError(f"survey {name}: there is no such file{'' if path.is_absolute() else where}")


def runout(value: float, slope: float, curvature: float, length: float) -> tuple[tuple[float, ...], float, float]:
    """How the map continues beyond an end of the survey: a smooth run-out to a constant value.

    Over the length L the slope falls from the end's slope s to zero as a cubic Hermite curve, from the end's curvature
    c to zero; its integral is the value. With distance t from the end, u = t/L:

        slope(t)  = s (1 − 3u² + 2u³) + c L (u − 2u² + u³)
        value(t)  = v + s (t − t³/L² + t⁴/(2L³)) + c (t²/2 − 2t³/(3L) + t⁴/(4L²))
        value(L)  = v + s L/2 + c L²/12

    Value, slope and curvature are continuous at both ends. Of the quintics with these end conditions it is the one
    without a fifth-degree term, because the held value is free: it is where the guide's slope leads.

    ``value``, ``slope`` and ``curvature`` are those at the end, in m, m/m and 1/m, with respect to t. Gives the
    polynomial coefficients of the value over t, constant first; the held value; and the value where the slope is zero
    on the way to it, or again the held value.
    """
    coefficients = (
        value,
        slope,
        curvature / 2.0,
        -slope / length**2 - 2.0 * curvature / (3.0 * length),
        slope / (2.0 * length**3) + curvature / (4.0 * length**2),
    )
    held = value + slope * length / 2.0 + curvature * length**2 / 12.0
    # slope(t) = (1 − u)² (s (1 + 2u) + c L u): one zero at most inside.
    divisor = 2.0 * slope + curvature * length
    u = -slope / divisor if divisor else 0.0
    turning = _polynomial(u * length, 0.0, *coefficients)[0] if 0.0 < u < 1.0 else held
    return coefficients, held, turning


def _polynomial(x: T, origin: T, c0: T, c1: T, c2: T, c3: T, c4: T) -> tuple[T, T, T]:
    """Value, slope and curvature; the same operations, and so the same bits, for numbers and for arrays."""
    t = x - origin
    return (
        c0 + t * (c1 + t * (c2 + t * (c3 + t * c4))),
        c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4))),
        2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4)),
    )
