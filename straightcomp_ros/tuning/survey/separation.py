"""The guide without the errors of the straightedge, from two surveys of it: by reversal, or by a shift.

The sensor on the slider reads m1 = guide + edge along the straightedge. **Reversal**: for the second survey the
straightedge is turned over about its long axis, at the same place along x, and the sensor with it, so that it reads
from the other side: the edge has the same sign again, the guide the other one, m2 = edge − guide. Therefore

    guide = (m1 − m2) / 2        edge = (m1 + m2) / 2

**Shift**: the straightedge, or the sensor on the slider, is moved by d along x. The guide is at the same x again and
the edge is not, m1 − m2 = edge(x) − edge(x ∓ d): least squares give the edge, as a spline, and m − edge the guide. What
has the period d, waves of d, d/2, d/3 …, leaves no difference. Of the edges that explain the readings the smoothest is
taken (least third difference), so that such waves of the edge stay in the guide. So does the parabola of a straightedge
that was moved, since it is aligned anew; a sensor that was moved sees it, if the slider does not yaw.

Both are in C. J. Evans, R. J. Hocken and W. T. Estler, Self-calibration: reversal, redundancy, error separation, and
'absolute testing', CIRP Annals 45, 1996. A line is removed from each result. The runs of both surveys are taken in
pairs, so that the separated runs have the noise of the measurement; its standard deviation at each point follows from
that between the runs of both surveys, since all results are linear in the readings.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from straightcomp_ros.analysis.map_building import MAP
from straightcomp_ros.analysis.straightness_statement import Input, Statement, stated
from straightcomp_ros.straightness.guide_map import MapParameters
from straightcomp_ros.straightness.residual import Array, rms
from straightcomp_ros.straightness.smoothing import measured, point_noise
from straightcomp_ros.straightness.survey import Run, Survey
from straightcomp_ros.straightness.survey_header import WAYS, Direction, SurveyError
from straightcomp_ros.straightness.survey_runs import cubic_spline, on_common_grid, repeatability

_LOUDEST = 10.0
"""A form of the edge counts as unseen where its noise, RMS over x, would be so many times that of a difference."""
_LONGEST = 0.1
"""Of the length: over fewer than ten periods, waves of the shift's length are hardly distinguished from others."""
_MOST = 3000
"""Points of two surveys between which something was shifted: the equations of the edge's spline are a matrix of so many
rows and columns, whose decomposition takes a minute."""
_SMOOTH = 1e-12
"""Third difference of a form of unit length that is a parabola but for rounding; a cubic over 2000 points has 1e-8."""


class Form(NamedTuple):
    """Of guide or straightedge: a run for each pair of runs; the mean deviation (n,) in m, and its standard uncertainty
    ``s`` (n,) by the noise, None if no run was repeated; the statements on it."""

    survey: Survey
    mean: Array
    s: Array | None
    lines: list[Statement]


class Separated(NamedTuple):
    """Guide and straightedge at ``x`` (n,) in m, and the number of runs without a partner."""

    guide: Form
    edge: Form
    x: Array
    left_out: int


def separated(
    normal: Survey,
    second: Survey,
    shift: float | None = None,
    moved: Literal["straightedge", "sensor"] = "straightedge",
    guide: MapParameters = MAP,
) -> Separated:
    """Guide and edge from the survey with the straightedge as it was and a ``second`` one: with it turned over, or
    where there is a ``shift``, with straightedge or sensor ``moved`` by so much in m towards larger x. ``guide`` says
    how many points a survey needs and how wide a gap may be.

    Raises:
        SurveyError: the surveys do not cover the same x, or have no direction in common; a shift that is less than the
            spacing or more than a tenth of the length, or between more points than can be solved for.
    """
    every = (*normal.runs, *second.runs)
    x, values = on_common_grid(Survey(every, f"{normal.source} and {second.source}"), guide.min_points, guide.max_gap)
    spacing, length = float(np.median(np.diff(x))), float(np.ptp(x))
    if shift is not None and not spacing - 1e-9 <= abs(shift) <= _LONGEST * length + 1e-9:
        raise SurveyError(
            f"survey {second.source}: shifted by {shift * 1e3:g} mm; allowed: from the spacing of the points, "
            f"{spacing * 1e3:g} mm, to a tenth of their length, {_LONGEST * length * 1e3:g} mm"
        )
    if shift is not None and x.size > _MOST:
        raise SurveyError(
            f"survey {second.source}: {x.size} points in the range that all runs cover; allowed with a shift: "
            f"<= {_MOST}; give surveys with points farther apart"
        )
    first, other = values[: len(normal.runs)], values[len(normal.runs) :]
    pairs = list[tuple[str, Direction, Array]]()
    for way in WAYS:
        both = (
            of_survey[[run.direction == way for run in survey.runs]]
            for survey, of_survey in ((normal, first), (second, other))
        )
        pairs += [(str(number), way, np.concatenate(pair)) for number, pair in enumerate(zip(*both, strict=False), 1)]
    if not pairs:
        raise SurveyError(f"survey {second.source}: has no run in a direction of {normal.source}; allowed: the same")
    noises = [point_noise(one, x, of_survey, measured(one, x)) for one, of_survey in ((normal, first), (second, other))]
    known, each = None not in noises, np.array(noises, np.float64)

    def form(name: str, part: _Part) -> Form:
        survey = Survey(tuple(Run(number, way, x, part.made(readings)) for number, way, readings in pairs), name)
        mean = repeatability(survey, x, np.array([run.deviation for run in survey.runs])).mean
        source = part.source if known else part.source._replace(uncertainty=None)
        lines = stated("before", pairs[0][1], [(x, x, mean)], [source], repeats=False, as_points=True)
        return Form(survey, mean, part.s if known else None, lines)

    if shift is None:
        of_edge, of_guide = _reversed(x, each)
    else:
        tilt = _line(x)[:, 0]
        drifts = np.array([_drift(normal, first @ tilt), _drift(second, other @ tilt)])
        of_edge, of_guide = _shifted(x, each, drifts, shift, moved)
    return Separated(form("guide", of_guide), form("edge", of_edge), x, len(every) - 2 * len(pairs))


class _Part(NamedTuple):
    """How edge or guide is ``made`` of the readings (2 n,) of both surveys, and what their noise leaves in it: its
    standard deviation (n,) in m, and the source of errors of its straightness."""

    made: Callable[[Array], Array]
    s: Array
    source: Input


def _line(x: Array, powers: int = 2) -> Array:
    """Orthonormal columns (n, powers) that span the lines at ``x``, or with one power the constants."""
    return np.asarray(np.linalg.qr(np.vander((x - x.mean()) / np.ptp(x), powers))[0])


def _drift(survey: Survey, tilts: Array) -> float:
    """Standard deviation of the mean of the runs' ``tilts``, by what they differ in each direction."""
    ways = np.array([run.direction for run in survey.runs])
    apart = [tilts[ways == way] - tilts[ways == way].mean() for way in np.unique(ways)]
    freedom = tilts.size - len(apart)
    return float(np.sqrt(sum(one @ one for one in apart) / max(freedom, 1) / tilts.size))


def _reversed(x: Array, noises: Array) -> tuple[_Part, _Part]:
    """Edge and guide by reversal; ``noises`` (2,) in m are those of a reading in each survey. Without matrices of n
    columns: there may be tens of thousands of points."""
    # SciPy's linear algebra takes a while to import, and a verb's help needs none of it.
    from scipy.sparse.linalg import LinearOperator

    line, each = _line(x), np.repeat(noises, x.size)
    s = float(np.hypot(*noises)) / 2.0 * np.sqrt(1.0 - np.sum(line**2, axis=1))
    noise = rms(s)

    def part(sign: float) -> _Part:
        def made(readings: Array) -> Array:
            mean = (readings[: x.size] + sign * readings[x.size :]) / 2.0
            return np.asarray(mean - line @ (line.T @ mean))

        def errors(independent: Array) -> Array:
            return made((independent.T * each).T) / (noise or 1.0)

        form = LinearOperator((x.size, each.size), matvec=errors, matmat=errors, dtype=np.float64)
        return _Part(made, s, Input("noise", noise, x, form=form))

    return part(1.0), part(-1.0)


def _shifted(x: Array, noises: Array, drifts: Array, shift: float, moved: str) -> tuple[_Part, _Part]:
    """As :func:`_reversed`, where straightedge or sensor was moved: a tilt between the surveys, of which their
    ``drifts`` (2,) in m are standard deviations, looks like a parabola of the edge to a moved sensor."""
    from scipy.linalg import pinv

    shift, aligned_anew = (-shift, False) if moved == "sensor" else (shift, True)
    low, high = min(x[0], x[0] - shift), max(x[-1], x[-1] - shift)
    knots = np.linspace(low, high, 1 + round((high - low) / float(np.median(np.diff(x)))))
    before, after = (cubic_spline(knots, np.eye(knots.size))(at) for at in (x, x - shift))
    level, free = (np.eye(x.size) - line @ line.T for line in (_line(x), _line(x, 2 if aligned_anew else 1)))
    left, sizes, right = np.linalg.svd(free @ (before - after), full_matrices=True)
    seen = int(np.count_nonzero(sizes * np.sqrt(knots.size) * _LOUDEST > 1.0))
    solution = right[:seen].T @ (left[:, :seen] / sizes[:seen]).T @ free
    unseen, rough = right[seen:].T, np.diff(np.eye(knots.size), 3, axis=0)
    smoothest = solution - unseen @ pinv(rough @ unseen, atol=_SMOOTH) @ (rough @ solution)
    difference = np.hstack([np.eye(x.size), -np.eye(x.size)])
    edges = smoothest @ difference
    mean = np.hstack([np.eye(x.size), np.eye(x.size)]) - (before + after) @ edges

    # More than noise makes.
    tilts = np.kron(np.diag(np.sqrt(np.maximum(drifts**2 - noises**2, 0.0))), _line(x)[:, :1])

    def part(operator: Array) -> _Part:
        errors = np.hstack([operator * np.repeat(noises, x.size), operator @ tilts])
        s = np.sqrt(np.sum(errors**2, axis=1))
        noise = rms(s)
        return _Part(operator.__matmul__, s, Input("noise", noise, x, form=errors / (noise or 1.0)))

    return part(level @ before @ edges), part(level @ mean / 2.0)
