"""Zero, scale and sign of a survey, from a few strokes over the same guide with a displacement sensor.

A sensor read m in stroke k at the machine's x; the stroke went in the direction d = ±1. With the survey's deviation δ
over its own x, u, whose middle is u_m (of two tables that of the direction),

    m = c_k + tilt (x − u_m) + gain δ(u),        x = u + shift + scale (u − u_m) + lag d

Offsets c_k and tilt are those of the sensor and its line. The gain is 1, or −1 where the survey has the other sign;
another value is an error of a unit. The lag, which takes strokes in both directions, is what a delayed reading shows.
Every shift within reach is tried, and each minimum refined by Gauss and Newton's method.

The uncertainty has two parts: the sensor's noise, by the differences of neighbouring readings, and what the survey's
noise leaves in the map. Where more than both is left, the guide is no longer as surveyed, or the sensor drifts: then
what is left takes the place of the map's noise, by its spectrum. Such intervals are rough: over random changes of
0.3 µm RMS they held the shift and the scale in 98 of 100 draws, gain and tilt in 80.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.straightness_statement import independent_points
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import Array, rms
from straightcomp_ros.straightness.smoothing import NORMAL_95
from straightcomp_ros.straightness.survey import Run, Survey
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.straightness.survey_runs import point_weights

_ITERATIONS, _SETTLED = 30, 1e-8
"""Of the refinement: it ends when the shift moves by less than this, in m, a ten-thousandth of what matters."""
_ANOTHER = 6.6
"""Excess of the squares, in units of one independent point, at which another shift is excluded: χ² of one degree of
freedom at 99 %."""
_SEEN = 4.0
"""Standard deviations by which the gain must differ from zero, else the guide is too flat for this sensor."""
_MORE = 1.5
"""Ratio of variances from which more is left than the survey's noise: hundreds of points scatter by a tenth."""
_TAKEN = 2.5
"""Variance of a change of the guide relative to what the fit leaves of it: it takes out what looks like a shift."""
_SHARE = 0.5
"""Of the survey, which the strokes must cover at least."""


class Estimate(NamedTuple):
    """A value with its standard uncertainty, both in SI units."""

    value: float
    uncertainty: float

    @property
    def half_width(self) -> float:
        """Of the interval that holds 95 %."""
        return NORMAL_95 * self.uncertainty

    @property
    def seen(self) -> bool:
        """Whether the interval excludes zero."""
        return abs(self.value) > self.half_width


class Alignment(NamedTuple):
    """How the machine's x and the sensor's readings differ from the survey; see the module.

    Attributes:
        middle: of the survey's x in m, where ``shift`` in m holds; scale and gain have no unit, ``tilt`` is in m/m.
        lag: half of the difference in x between the directions, m; None without strokes in both.
        before, after: RMS in m of what the survey leaves unexplained as it is, and aligned.
        changed: whether more is left than sensor and survey explain.
        ambiguous: another shift in m that explains the strokes as well; None if there is none.
    """

    middle: float
    shift: Estimate
    scale: Estimate
    gain: Estimate
    tilt: Estimate
    lag: Estimate | None
    before: float
    after: float
    changed: bool
    ambiguous: float | None

    @property
    def sign(self) -> int:
        """-1 where the survey has the other sign than the sensor."""
        return -1 if self.gain.value < 0.0 else 1

    @property
    def found(self) -> bool:
        """Whether the strokes identify anything: the sensor sees the guide, and fits at one shift alone."""
        return self.ambiguous is None and abs(self.gain.value) > _SEEN * self.gain.uncertainty

    @property
    def differs(self) -> bool:
        """Whether zero, scale or sign are seen to differ."""
        return self.shift.seen or self.scale.seen or self.sign < 0

    def applied(self, survey: Survey, tilt: bool = False) -> Survey:
        """The survey over the machine's x with the sensor's sign, and with ``tilt`` against the sensor's line. What is
        within its uncertainty of zero is not taken over."""
        shift, scale, slope = (one.value if one.seen else 0.0 for one in (self.shift, self.scale, self.tilt))

        def corrected(run: Run) -> Run:
            arm = run.x - self.middle
            line = slope * arm if tilt else 0.0
            return replace(run, x=run.x + shift + scale * arm, deviation=self.sign * run.deviation + line)

        return replace(survey, runs=tuple(map(corrected, survey.runs)))


class _Fit(NamedTuple):
    """``place`` is (shift, scale, lag); residual (n,) in m; the design (n, p) of place, gain, tilt and offsets."""

    place: Array
    squares: float
    gain: float
    tilt: float
    residual: Array
    design: Array
    u: Array


def align(straightness: StraightnessMap, strokes: Sequence[Run], reach: float) -> Alignment:
    """Find how the survey behind the map lies in the machine, by ``strokes`` whose deviations are the sensor's; the
    shift is sought up to ``reach`` in m to each side.

    Raises:
        SurveyError: the strokes cover less than half of the survey, or the best shift is at the end of the reach.
    """
    first, last = straightness.span
    middle, source = (first + last) / 2.0, straightness.survey.source
    x, readings = (np.concatenate([getattr(run, name) for run in strokes]) for name in ("x", "deviation"))
    numbers = np.repeat(np.arange(len(strokes)), [run.x.size for run in strokes])
    ways = np.where([run.direction == "forward" for run in strokes], 1.0, -1.0)[numbers]
    both = bool(np.ptp(ways))

    def fit(place: Array, keep: NDArray[np.bool_]) -> _Fit:
        arm, way = x[keep] - middle, ways[keep]
        u = middle + (arm - place[0] - place[2] * way) / (1.0 + place[1])
        reference, slope, _ = straightness.evaluate(u, way)
        offsets = (numbers[keep][:, None] == np.unique(numbers[keep])).astype(np.float64)
        linear = np.column_stack([straightness.offset - reference, arm, offsets])
        solved = np.linalg.lstsq(linear, readings[keep], rcond=None)[0]
        residual = readings[keep] - linear @ solved
        # dδ/du = −dr/du; u falls when shift, scale or lag rise.
        moved = solved[0] * slope / (1.0 + place[1])
        of_place = np.column_stack([moved, moved * (u - middle), *([moved * way] if both else [])])
        design = np.hstack([of_place, linear])
        gain, tilt = solved[:2].tolist()
        return _Fit(place, float(residual @ residual), gain, tilt, residual, design, u)

    def refined(shift: float) -> _Fit:
        place = np.array([shift, 0.0, 0.0])
        # The same points in every step: those that stay within the survey.
        keep = (x - shift > first) & (x - shift < last)
        for _ in range(_ITERATIONS):
            found = fit(place, keep)
            step = np.linalg.lstsq(found.design, found.residual, rcond=None)[0][: 2 + both]
            place = place + np.pad(step, (0, 3 - step.size))
            if abs(step[0]) < _SETTLED or abs(place[0]) > 2.0 * reach:
                break
        return fit(place, keep)

    core = (x > first + reach) & (x < last - reach)
    if not core.any() or np.ptp(x[core]) < _SHARE * (last - first):
        raise SurveyError(
            f"survey {source}: the strokes, from {x.min() * 1e3:.6g} to {x.max() * 1e3:.6g} mm, cover less than half "
            f"of it, which is from {first * 1e3:.6g} to {last * 1e3:.6g} mm; allowed: longer strokes or a shorter reach"
        )
    spacing = float(np.median(np.diff(straightness.report.x)))
    count = int(np.ceil(reach / max(spacing / 4.0, reach / 200.0)))
    shifts = np.linspace(-reach, reach, 2 * count + 1)
    squares = np.array([fit(np.array([one, 0.0, 0.0]), core).squares for one in shifts])
    lowest = np.flatnonzero((squares <= np.r_[np.inf, squares[:-1]]) & (squares <= np.r_[squares[1:], np.inf]))
    fits = [refined(float(shifts[at])) for at in lowest]
    best = min(fits, key=lambda one: one.squares / one.residual.size)
    variance, independent = best.squares / best.residual.size, independent_points(straightness)
    another = next(
        (
            float(one.place[0])
            for one in fits
            if abs(one.place[0] - best.place[0]) > spacing
            and one.squares / one.residual.size < variance * (1.0 + _ANOTHER / independent.size)
        ),
        None,
    )
    deviations, changed = _uncertainties(straightness, best, independent)
    names = ("shift", "scale", *(["lag"] if both else []), "gain", "tilt")
    values = dict(zip(("shift", "scale", "lag"), best.place.tolist(), strict=True), gain=best.gain, tilt=best.tilt)
    found = {name: Estimate(values[name], of) for name, of in zip(names, deviations.tolist(), strict=False)}
    inside = (x > first) & (x < last)
    lines = fit(np.zeros(3), inside).design[:, 3 + both :]
    apart = readings[inside] - straightness.deviations(x[inside], ways[inside])
    before = apart - lines @ np.linalg.lstsq(lines, apart, rcond=None)[0]
    result = Alignment(
        middle=middle,
        lag=found.pop("lag", None),
        before=rms(before),
        after=float(np.sqrt(variance)),
        changed=changed,
        ambiguous=another,
        **found,
    )
    if result.found and abs(result.shift.value) > reach:
        raise SurveyError(
            f"survey {source}: the strokes fit best beyond a shift of {reach * 1e3:g} mm; allowed: a longer reach"
        )
    return result


def _uncertainties(straightness: StraightnessMap, best: _Fit, independent: Array) -> tuple[Array, bool]:
    """Standard uncertainty (p,) of each column of the design, and whether more is left than both noises explain."""
    residual, influence = best.residual, np.asarray(np.linalg.pinv(best.design), np.float64)
    # Between two strokes x jumps; that is one difference of thousands.
    noise = float(np.mean(np.diff(residual) ** 2)) / 2.0
    left = best.squares / (residual.size - best.design.shape[1]) - noise
    surveyed = best.gain**2 * float(np.mean(straightness.noise.deviation**2))
    variance = noise * np.sum(influence**2, axis=1)
    if left <= _MORE * surveyed + 4.0 * noise * np.sqrt(3.0 / residual.size):
        errors = point_weights(independent, best.u, influence)
        return np.sqrt(variance + surveyed * np.sum(errors**2, axis=1)), False
    # Over pieces of x: the spectra of the influence on each parameter and of what is left, from wave to wave the mean
    # of three.
    place = np.searchsorted(independent, best.u)
    pieces = int(place.max()) + 1
    means = np.bincount(place, residual) / np.maximum(np.bincount(place), 1)
    waves = np.abs(np.fft.fft([np.bincount(place, one, pieces) for one in influence])) ** 2
    power = np.abs(np.fft.fft(means)) ** 2
    power = (np.roll(power, 1) + power + np.roll(power, -1)) / 3.0
    return np.sqrt(variance + _TAKEN * (waves @ power) / pieces**2), True
