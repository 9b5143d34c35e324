"""Straightness as ISO 230-1 states it: about three lines, each with its expanded uncertainty and the budget behind it.

The values are those of an instrument: the guide by the map (or a displacement sensor that was recorded), the platform
by the encoder, never the truth of a simulation. A value is the mean over the strokes of one direction, of which those
with stops on the way are whole strokes; much shorter ones, and those that a sensor measured in part, are left out.

A peak-to-peak value is a difference of extremes, so that errors do not only spread it, they move it: errors in the
measured curve make it larger, and what the measurement cannot see makes the true one larger than the measured. Both are
propagated by Monte Carlo (JCGM 101:2008, supplement 1 to the GUM) with a fixed seed: errors are drawn and added to the
measured curve, from which the mean over pieces of x has taken the noise of single samples. The mean change of the
straightness is the correction of the value, its standard deviation the contribution to the uncertainty; sensitivity is
their ratio to the standard uncertainty of the input (numerically, GUM 5.1.4).

- repeatability: standard deviation between the strokes of one direction; for few strokes widened by Student's t, so
  that k = 2 holds 95 % (GUM, annex G);
- encoder: q/√12 of y, uniform. Samples scatter about the mean curve by the encoder's errors and by the platform's own
  motion, whose extremes are real: the variance beyond q²/12 is taken for motion, and as many samples are independent as
  the correlation from one sample to the next leaves. Where samples scatter by less than q/√12, the readings stand still
  and hide the rest, which is then in the true straightness alone. Repeatability contains it: the larger one counts;
- map: what the survey's noise leaves in it; normal, independent at as many points as the map has independent ones, the
  same in all strokes;
- sensor: as given; normal, independent at points 10 mm apart, the same in all strokes.

The platform follows the map: no encoder sees its errors, so that they are in the true straightness after compensation
and not in the measured one. Before compensation the map is the measurement. Not in the budget: errors of the encoder
between its counts (interpolation), which no stage file describes, and errors of the survey's straightedge that all runs
share.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.evaluation import BagEvaluation
from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.analysis.metrics import LINES, about_lines
from straightcomp_ros.analysis.record import Array, group_means, whole, whole_ways
from straightcomp_ros.bags import WARNINGS
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import minimum_zones, rms, zone_along
from straightcomp_ros.straightness.survey_header import WAYS, Direction
from straightcomp_ros.straightness.survey_runs import cubic_spline

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

COVERAGE_FACTOR = 2.0
_COVERAGE = 0.9545
"""Of a normal distribution within ±2 standard deviations."""
_PIECES, POINTS = 200, 2000
"""Pieces of x for which a stroke is averaged, and the points of a curve measured once that are taken as they are."""
_DRAWS, _CURVES = 200, 1000
"""Of what is not in the curve, and of what is: the standard deviation of a contribution is then known to 5 and 2 %."""
_ALLOWED = 0.95
"""Share of drawn errors that the curve without them may differ by."""
_IN_CACHE = 50_000
"""Numbers that are computed at a time, half a megabyte: three times as fast as with all draws at once."""
_MOST = 32
"""Samples of a piece that are drawn: more move its extremes by a hundredth of an error's range."""
_CERTAIN = 3.0
"""Standard uncertainties by which samples must scatter more than the encoder makes them, for the platform to move."""
_SENSOR_POINTS = 0.01
"""Distance in m at which errors of a sensor and its straightedge are taken to be independent."""


class Input(NamedTuple):
    """A source of errors of a curve over x.

    Attributes:
        name: what it is called in a budget.
        uncertainty: standard uncertainty in m of one error; None if it is not known.
        points: x in m at which the errors are independent, with a spline between; None: from sample to sample.
        seen: whether the errors are in the measured curve, or in the true one alone.
        form: (points, m) what makes the errors of m independent ones, a matrix or an operator; None where they are
            independent.
    """

    name: str
    uncertainty: float | None
    points: Array | None = None
    seen: bool = True
    form: "Array | LinearOperator | None" = None


class Contribution(NamedTuple):
    """A line of a budget: the input's standard uncertainty in m (None: not known), what it does to the straightness in
    m as a standard deviation (``share``) and on average (``correction``), and whether it counts."""

    name: str
    uncertainty: float | None
    share: float = 0.0
    correction: float = 0.0
    counts: bool = True


class Statement(NamedTuple):
    """The straightness ``when`` (before or after compensation) about ``line``, in m; ``measured`` is the mean over
    ``strokes`` strokes, without ``left_out`` others."""

    when: str
    direction: Direction
    line: str
    strokes: int
    measured: float
    budget: tuple[Contribution, ...]
    left_out: int = 0

    @property
    def value(self) -> float:
        """Without what errors have added to the measured one, with what it could not see; m."""
        return max(0.0, self.measured + sum(one.correction for one in self.budget))

    @property
    def standard_uncertainty(self) -> float:
        """In m, of the contributions that are known; NaN where none is."""
        known = [one.share for one in self.budget if one.counts and one.uncertainty is not None]
        return math.sqrt(sum(share**2 for share in known)) if known else math.nan

    @property
    def expanded_uncertainty(self) -> float:
        """In m, with the coverage factor 2; NaN where the standard uncertainty is."""
        return COVERAGE_FACTOR * self.standard_uncertainty

    @property
    def unknown(self) -> list[str]:
        """Contributions that are not known, and not in the uncertainty."""
        return [one.name for one in self.budget if one.uncertainty is None]

    def to_display(self) -> dict[str, Any]:
        """As a person reads it: lengths in µm, None where not known; the budget as a list."""
        lengths = {
            name: getattr(self, name) * 1e6
            for name in ("measured", "value", "standard_uncertainty", "expanded_uncertainty")
        }
        return {
            **{name: getattr(self, name) for name in ("when", "direction", "line", "strokes", "left_out")},
            **{f"{name}_um": None if math.isnan(length) else length for name, length in lengths.items()},
            "coverage_factor": COVERAGE_FACTOR,
            "unknown": self.unknown,
            "budget": [
                {
                    "contribution": one.name,
                    "standard_uncertainty_um": one.uncertainty and one.uncertainty * 1e6,
                    "sensitivity": one.share / one.uncertainty if one.uncertainty else None,
                    "share_um": one.share * 1e6,
                    "correction_um": one.correction * 1e6,
                    "counts": one.counts,
                }
                for one in self.budget
            ],
        }


def with_uncertainty(value: float, expanded: float) -> str:
    """A value and its expanded uncertainty in µm, both to two digits of the latter (GUM 7.2.6)."""
    digits = 3 if not expanded > 0.0 else max(0, 1 - math.floor(math.log10(float(f"{expanded:.1e}"))))
    return f"({value:.{digits}f} ± {expanded:.{digits}f}) µm"


def budget_rows(displayed: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row for each statement in the form of :meth:`Statement.to_display`: value and uncertainty, and as a column each
    contribution to the standard uncertainty; in brackets one that does not count."""
    longest: list[Any] = max((statement["budget"] for statement in displayed), key=len, default=[])
    names = [one["contribution"] for one in longest]
    rows = []
    for statement in displayed:
        cells: dict[str, Any] = dict.fromkeys(f"u_{name}_um" for name in names)
        for one in statement["budget"]:
            share = with_digits(one["share_um"], 3)
            known = share if one["counts"] else f"({share})"
            cells[f"u_{one['contribution']}_um"] = "?" if one["standard_uncertainty_um"] is None else known
        what = f"{statement['when']}, {statement['direction']}, {statement['line'].replace('_', ' ')}"
        # Statements of a stored certificate may be older.
        what += f", without {statement['left_out']} strokes" if statement.get("left_out") else ""
        figures = {name: statement[f"{name}_um"] for name in ("measured", "value", "expanded_uncertainty")}
        shown = {f"{name}_um": "?" if figure is None else with_digits(figure, 3) for name, figure in figures.items()}
        rows.append({"straightness": what, **shown, **cells})
    return rows


Samples = tuple[Array, Array, Array]
"""Time in s, x in m and deviation in m of a stroke, (n,) each."""


def statements(evaluation: BagEvaluation, sensor: float | None = None) -> list[Statement]:
    """Of a run, before and after compensation, for each direction and line. ``sensor`` is the standard uncertainty in m
    of a recorded displacement sensor, which then takes the place of the map. None where the guide is not known: there
    is no map, and the reference was centred, or the sensor has no readings."""
    record, readings, found = evaluation.record, evaluation.guide, list[Statement]()
    by_sensor = sensor is not None
    guide = readings if by_sensor else record.guide_by(evaluation.map or record.reference)
    if guide is None or not (by_sensor or evaluation.map or np.ptp(record.moving.r)):
        return []
    count = evaluation.parameters.get("driver", {}).get("stage.encoder.y_resolution")
    encoder = Input("encoder", None if count is None else float(count) / math.sqrt(12.0))
    points = np.arange(record.x.min(), record.x.max() + _SENSOR_POINTS, _SENSOR_POINTS)
    of_run = whole_ways(record.motion.strokes, record.x)
    for direction in WAYS:
        strokes, shorter = ([way for way in ways if way[0].direction == direction] for ways in of_run)
        moving = [np.concatenate([np.arange(one.start, one.stop) for one in way]) for way in strokes]
        for when, curve in (("before", guide), ("after", guide + record.y)):
            after = when == "after"
            source = Input("sensor", sensor, points) if by_sensor else map_input(evaluation.map, seen=not after)
            series = list[Samples]()
            for way in moving:
                known, piece = np.isfinite(curve[way]), _piece_of(record.x[way])
                at = way[known]
                # A sensor that began, ended or failed within a stroke has measured a part of the guide.
                if at.size > 2 * _PIECES and whole(np.unique(piece[known]).size, np.unique(piece).size):
                    series.append((record.time[at], record.x[at], curve[at]))
            if series:
                # By the map, the guide is the same in all strokes.
                inputs = [*([encoder] if after else []), source]
                made = stated(when, direction, series, inputs, repeats=after or by_sensor)
                found += [one._replace(left_out=len(shorter) + len(moving) - len(series)) for one in made]
    return found


def stated(
    when: str,
    direction: Direction,
    strokes: Sequence[Samples],
    inputs: Sequence[Input],
    repeats: bool = True,
    as_points: bool = False,
) -> list[Statement]:
    """The statements about each line from the ``strokes`` of one direction; where they ``repeats`` a measurement, with
    the standard deviation between them. ``as_points``: of one curve over ascending x, whose points count the same."""
    of_strokes = [about_lines(x, curve, np.abs(np.gradient(x, time))) for time, x, curve in strokes]
    values = np.array([[*one.values()] for one in of_strokes])
    budgets = [[_repeatability(one)] if repeats else [] for one in values.T]
    random = np.random.default_rng(0)
    for one in inputs:
        changes = np.zeros((1, len(LINES)))
        if one.uncertainty is not None and one.points is None:
            changes = _readings(one.uncertainty, strokes, random)
        elif one.uncertainty is not None:
            curve = strokes[0][1:] if as_points and strokes[0][1].size <= POINTS else _mean_curve(strokes)[:2]
            changes = _changes(one, one.uncertainty, *curve, random)
        shares = changes.std(axis=0) / math.sqrt(len(strokes) if one.points is None else 1)
        corrections = (-1.0 if one.seen else 1.0) * changes.mean(axis=0)
        for budget, share, correction in zip(budgets, shares.tolist(), corrections.tolist(), strict=True):
            budget.append(Contribution(one.name, one.uncertainty, share, correction))
    return [
        Statement(when, direction, line, len(strokes), float(of_line.mean()), _larger_of_random(budget))
        for line, of_line, budget in zip(LINES, values.T, budgets, strict=True)
    ]


def map_input(straightness: StraightnessMap | None, seen: bool) -> Input:
    """By the standard deviation of the map, RMS over x."""
    if straightness is None:
        return Input("map", None, np.empty(0), seen)
    points = independent_points(straightness)
    if points.size > POINTS:  # no curve has more
        points = np.linspace(*straightness.span, POINTS)
    return Input("map", rms(straightness.noise.deviation), points, seen)


def independent_points(straightness: StraightnessMap) -> Array:
    """The x in m at which errors of the map are independent, with a spline between: where smoothing made its standard
    deviation smaller by the factor f than that of a point of the survey, 1/f² times fewer than the survey's points."""
    noise, points = straightness.noise, straightness.report.x
    left = min(1.0, rms(noise.deviation) / noise.point) ** 2 if noise.point else 1.0
    return np.linspace(*straightness.span, max(4, round(left * points.size)))


def _piece_of(x: Array) -> NDArray[np.intp]:
    """The number of the piece of their way that each ``x`` (n,) is in."""
    return np.asarray((x - x.min()) / (np.ptp(x) / _PIECES)).astype(np.intp).clip(0, _PIECES - 1)


def _mean_curve(strokes: Sequence[Samples]) -> tuple[Array, Array, Array]:
    """Over the pieces (n,) of x: middle and mean deviation in m, and samples of a stroke."""
    x, curve = (np.concatenate([one[column] for one in strokes]) for column in (1, 2))
    place = _piece_of(x)
    means = group_means(x, curve, place)
    return *means, np.maximum(np.unique(place, return_counts=True)[1] / len(strokes), 1.0)


def _readings(uncertainty: float, strokes: Sequence[Samples], random: np.random.Generator) -> Array:
    """(draws, lines) how far the straightness of readings with this standard ``uncertainty`` in m is from that of the
    motion which they read, in m, from stroke to stroke."""
    curves = [_mean_curve([one]) for one in strokes]
    squares = products = count = 0.0
    for (_, at, deviation), (x, mean, _) in zip(strokes, curves, strict=True):
        left = deviation - np.interp(at, x, mean)
        squares += float(left @ left)
        products += max(0.0, float(left[1:] @ left[:-1]))
        count += left.size - x.size
    # Of a first-order autoregression, the share of samples that are as good as independent.
    independent = (squares - products) / (squares + products) if squares else 1.0
    variance, certain = squares / count, 1.0 + _CERTAIN * math.sqrt(2.0 / (count * independent))
    hidden = max(0.0, 1.0 - variance / uncertainty**2) if uncertainty else 0.0
    motion, half = math.sqrt(max(0.0, variance - uncertainty**2 * certain)), math.sqrt(3.0) * uncertainty
    draws, changes = math.ceil(_DRAWS / len(strokes)), []
    for x, mean, samples in curves:
        drawn = np.maximum(samples * independent, 1.0).clip(max=_MOST)[:, None] > np.arange(_MOST)
        moving = motion * random.standard_normal((draws, *drawn.shape))
        errors = half * math.sqrt(1.0 - hidden) * random.uniform(-1.0, 1.0, moving.shape)
        slow = half * math.sqrt(hidden) * random.uniform(-1.0, 1.0, (draws, x.size))
        read, true = _extremes(mean, moving + errors, drawn), _extremes(mean + slow, moving, drawn)
        changes.append(_straightness(x, *read) - _straightness(x, *true))
    return np.concatenate(changes)


def _changes(one: Input, uncertainty: float, x: Array, mean: Array, random: np.random.Generator) -> Array:
    """(draws, lines) how errors of the input at its points change the straightness of the curve ``mean`` (n,) over
    ``x`` (n,), in m."""
    assert one.points is not None
    draws = _CURVES if one.seen else _DRAWS
    at_points = random.normal(0.0, uncertainty, (one.points.size if one.form is None else one.form.shape[1], draws))
    if one.form is not None:
        at_points = np.asarray(one.form @ at_points)
    errors = cubic_spline(one.points, at_points)(x.clip(*one.points[[0, -1]])).T

    def changes(curve: Array) -> Array:
        changed = curve + errors
        drawn = _straightness(x, changed, changed, changed[:, [0, -1]])
        return np.asarray(drawn - [*about_lines(x, curve, np.abs(np.gradient(x))).values()])

    if not one.seen:
        return changes(mean)
    found = changes(_without(one.points, at_points, x, mean))
    # The curve that the correction is of is known no better than it differs from the one that was measured.
    unsure = found.mean(axis=0) - changes(mean).mean(axis=0)
    return np.asarray(found + unsure * random.uniform(-1.0, 1.0, (len(found), 1)))


def _extremes(middle: Array, samples: Array, count: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Highest and lowest (draws, n) of ``samples`` (draws, n, most) about ``middle``, of those that ``count``
    (n, most), and the first and the last sample (draws, 2)."""
    high = middle + np.where(count, samples, -math.inf).max(axis=2)
    low = middle + np.where(count, samples, math.inf).min(axis=2)
    ends = samples[:, [0, -1], 0] + np.broadcast_to(middle, high.shape)[:, [0, -1]]
    return high, low, ends


def _straightness(x: Array, high: Array, low: Array, ends: Array) -> Array:
    """(draws, lines) of curves between ``low`` and ``high`` (draws, n) over ``x`` (n,), which begin and end at ``ends``
    (draws, 2); all in m."""
    arm, rows, found = x - x.mean(), max(1, _IN_CACHE // x.size), list[Array]()
    for begin in range(0, len(high), rows):
        above, below, between = (values[begin : begin + rows] for values in (high, low, ends))
        slopes = (above + below) @ arm / (2.0 * arm @ arm), np.diff(between).ravel() / np.ptp(x)
        about = (zone_along(one, x, above, below)[0] for one in slopes)
        found.append(np.column_stack([*about, minimum_zones(slopes[0], x, above, below)]))
    return np.concatenate(found)


def _without(points: Array, errors: Array, x: Array, mean: Array) -> Array:
    """The curve without ``errors`` (points, draws) that are in it, of which added ones would move its extremes less: as
    smooth as they allow, no farther from ``mean`` than all but one in twenty of them are from zero (C. H. Reinsch,
    Numer. Math. 10, 1967; his m + √(2m) is for independent ones)."""
    inside = (points >= x[0]) & (points <= x[-1])
    deviation = errors[inside].std(axis=1)
    if deviation.size < 4 or not deviation.all():
        return mean
    from scipy.interpolate import UnivariateSpline

    distance = float(np.quantile(np.sum((errors[inside] / deviation[:, None]) ** 2, axis=0), _ALLOWED))
    with WARNINGS, warnings.catch_warnings():
        # Where errors are a billionth of the curve, the distance is not met exactly.
        warnings.simplefilter("ignore")
        spline = UnivariateSpline(points[inside], np.interp(points[inside], x, mean), 1.0 / deviation, s=distance)
    return np.asarray(spline(x))


def _repeatability(values: Array) -> Contribution:
    """From the straightness (n,) in m of n strokes: s/√n, wider by Student's t over 2 for n − 1 degrees of freedom."""
    from scipy.special import stdtrit

    n = values.size
    if n < 2:
        return Contribution("repeatability", None)
    s = float(values.std(ddof=1))
    factor = float(stdtrit(n - 1, 0.5 + _COVERAGE / 2.0)) / COVERAGE_FACTOR
    return Contribution("repeatability", s, s / math.sqrt(n) * factor)


def _larger_of_random(budget: Sequence[Contribution]) -> tuple[Contribution, ...]:
    """Strokes differ by the encoder's errors too: of both, the smaller does not count."""
    largest = max((one.share for one in budget if one.name in ("repeatability", "encoder")), default=0.0)
    return tuple(
        one._replace(counts=one.name not in ("repeatability", "encoder") or one.share == largest) for one in budget
    )
