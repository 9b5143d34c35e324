"""What makes an error that is not the law's: the mains, something locked to x, friction, a mode, a vibration, or the
loop itself.

Each is known by facts of the record, not by the size of the error:

- **mains**: a line at 50 or 60 Hz or a multiple. It keeps its phase over the whole run, whatever the speed, and is
  there at rest too; the loop's own oscillation mostly wanders off. A limit cycle of few whole samples does not: at its
  frequency the mains need another line of their comb.
- **locked to x**: a line that keeps its phase over x, in both directions. Its frequency follows the speed: the ramps at
  both ends of a stroke distinguish it from a line in time.
- **friction** (stick-slip, hunting): the platform stands most of the time and jumps in between. Its velocity is then
  far from that of a sine or of noise: kurtosis 1.5 and 3.
- **a cable that drags**: a force that turns round with the travel of the stage, whereas friction turns round with the
  platform's.
- **a mode**: a line at a described frequency of the platform.
- **vibration**: a line whose amplitude comes and goes as that of noise behind a resonance; a loop that oscillates sets
  its own amplitude.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.judged_motion import JudgedMotion, encoder_count
from straightcomp_ros.analysis.record import Array
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import least_squares_residual
from straightcomp_ros.straightness.smoothing import NORMAL_95

MAINS = (50.0, 60.0)
"""Frequencies in Hz of the world's grids."""
_GRID = 0.004
"""Relative tolerance of a grid's frequency: large grids keep it within 0.2 Hz, but for rare moments."""
_MULTIPLES = range(1, 7)
"""Up to the ripple of a six-pulse rectifier."""
_CYCLE = 12
"""Longest limit cycle in samples whose period the sampling holds: a relay with a delay of two has 8."""
_OF_COMB = 0.1
"""Least amplitude of another line of the mains relative to the one that is found."""
_WAVES_AT_REST = 12
"""Waves in a rest from which its line can be distinguished from what is around it."""
_STANDS_OUT = 5.0
"""Amplitude of a line relative to the median around it: of noise, one in 10^7 has as much."""
_COHERENT = 0.5
"""Least part of a line's amplitude that keeps its phase over a whole stroke; of one that wanders by a cycle, none."""
_AROUND = 0.15
"""Relative distance from the frequency of a line in a short segment within which that of the whole run lies."""
_BINS, _FINER = 16, 4
"""Bins for a wave, and frequencies within the resolution of the whole length."""
_PLACES = 500
"""Places of x at which curves are compared."""
_FARTHEST, _SHIFT = 0.05, 0.25e-3
"""Shifts of x in m that are tried for a map: to each side, and from one to the next."""
_EXPLAINED = 0.2
"""Share of the square of a map's error that a cause may leave."""
_REPEATS = 0.7
"""Least correlation over x between strokes of one direction whose errors are the same."""
_FASTEST, _FEW_WAVES = 100.0, 4.0
"""Frequency in Hz to well beyond which waves over x are looked for, and the least number of waves in a stroke."""
_A_WAVE = 0.7
"""Least amplitude of a wave that names an error, relative to its RMS: a quarter of its power."""
_SLOW = 0.1
"""Standard deviation in s of the filter behind which an error is slow: below some 1 Hz."""
_MOST = 0.5
_STEP = 0.01
"""Time in s from which a reversal of the reference is taken: it is no rounding then."""
_AFTER, _AT_REVERSALS = 0.1, 4.0
"""Time in s after a reversal of the reference, and how much more of the squared error friction makes there."""
_WITH_MOTION = 0.5
"""Least correlation of an error that friction makes with the direction of the reference. With 20 to 60 times the
friction it was 0.63 and 0.71, with an offset that drifts at most 0.03."""
_SAME_WAY = 0.9
"""Mean product of the directions of platform and stage, either sign, from which their forces are not distinguished:
at most one sample in twenty then has one without the other."""
_OF_A_MODE = 0.1
"""Relative distance from a mode within which a line is of it: a loop that a mode destabilises shifts it a little."""
_STANDS, _STANDING = 0.4, 0.2
"""Least fraction of the time in which the platform stands in stick-slip, at less than this fraction of its RMS
velocity: 0.16 of noise. It was 0.4 to 0.9 with stiction, 0.1 to 0.25 without."""
_JUMPING, _IN_BURSTS = 2.0, 0.25
"""Velocity of a jump relative to its RMS; and the time for which the platform stands between jumps to opposite sides
relative to that in all of the run: it was 0.3 to 2 with stiction, 0.1 to 0.2 in the bursts of a loop at its limit."""
_JUMPS = 4.5
"""Least kurtosis of the velocity then, 3 of noise. It was 5 to 20 with stiction, 1.5 to 4.6 without; an oscillation
that comes and goes has as much, but stands less."""
_COMES_AND_GOES = 0.5 * (math.sqrt(math.log(4.0)) - math.sqrt(math.log(4.0 / 3.0))) / math.sqrt(math.log(2.0))
"""Distance between the quartiles of a line's amplitude, relative to its median, that is noise: half of Rayleigh's."""
_ENDS = 0.05
"""Part of a filtered piece at each end whose amplitude depends on what was before and after."""
UNKNOWN = "compare the machine with its description (straightcomp friction BAG), and look for a fault or a load"
"""What there is to say of an error of which no cause shows."""
MEASURE_RESPONSE = "straightcomp frequency-response --graph running (of a simulated stage: --stage FILE)"
"""What measures the loop that ran: without an option it would be the simulated shipped stage's."""
_VELOCITY_OVER = 0.002
"""Time in s over which the velocity is taken: a slip lasts some milliseconds."""


class Line(NamedTuple):
    """A line that keeps its phase: amplitude in m; its frequency in Hz, or waves in 1/m."""

    amplitude: float
    at: float


def mains(motion: JudgedMotion, line: Line) -> Line | None:
    """The ``line`` that was found in segments of the error, if it is of the mains; the error in each rest between
    strokes must have it too, where they are long enough to show it."""
    time, error, period = motion.time, motion.error, motion.period
    found = _strongest(*_spectrum(time, error, line.at), (1.0 - _AROUND) * line.at, (1.0 + _AROUND) * line.at)
    of_grid = [n for one in MAINS for n in _MULTIPLES if abs(found.at / (n * one) - 1.0) <= _GRID]
    if not of_grid or found.amplitude < _COHERENT * line.amplitude:
        return None
    samples, resolution = 1.0 / (found.at * period), 1.0 / float(np.ptp(time))
    whole = 2 * round(0.5 * samples)
    if whole <= _CYCLE and abs(found.at - 1.0 / (whole * period)) <= resolution:
        # A symmetric limit cycle has odd multiples of its own frequency.
        others = [(m, n) for n in of_grid for m in _MULTIPLES if m % n or (m // n) % 2 == 0]
        if not any(_stands_out(time, error, found.at * m / n, _OF_COMB * found.amplitude) for m, n in others):
            return None
    rests = [one for one in motion.resting() if one.size * period * found.at >= _WAVES_AT_REST and np.ptp(one) > 0.0]
    in_all = all(_stands_out(period * np.arange(one.size, dtype=np.float64), one, found.at) for one in rests)
    return found if in_all else None


def locked_to_x(motion: JudgedMotion) -> Line | None:
    """The strongest wave of the error over x, if in each whole stroke it has more of the error than any line in time,
    and enough to name it."""
    found = []
    for samples in (stroke.samples for stroke in motion.whole_strokes):
        time, x, error = motion.time[samples], motion.x[samples], motion.error[samples]
        # Of a coarse encoder most samples stand.
        speed = max(float(np.quantile(np.abs(np.gradient(x, time)), 0.9)), float(np.ptp(x) / np.ptp(time)))
        # Bins finer than a count of x would repeat the slow part of the error as a wave of one count.
        near = min(_FASTEST / speed, 1.0 / (_BINS * encoder_count(x)))
        over_x, over_time = _of_few_waves(x, error, near), _of_few_waves(time, error, _FASTEST)
        # At constant speed both are the same line: the ramps make the difference, which noise must not make.
        noise = _background(*_spectrum(x, error, over_x.at), float(np.ptp(x)), over_x.at)
        if over_x.amplitude < max(_A_WAVE * motion.rms, over_time.amplitude + noise):
            return None
        found.append(over_x)
    return min(found, default=None)


def mode_of(frequency: float, modes: Sequence[float]) -> float | None:
    """The frequency in Hz of the described mode that a line at ``frequency`` is of."""
    nearest = min(modes, key=lambda mode: abs(mode - frequency), default=math.inf)
    return nearest if abs(frequency / nearest - 1.0) <= _OF_A_MODE else None


def comes_and_goes(pieces: Sequence[Array], frequency: float, period: float) -> bool:
    """Whether the line at ``frequency`` in Hz comes and goes in the steadier half of the ``pieces`` of the error, (m,)
    in m, of samples ``period`` s apart without a gap: where an oscillation has just begun, it is not steady either."""
    spreads = []
    for error in pieces:
        # Flat where a line wanders; without edges, so that a jump, as from the end to the beginning, rings shortly.
        off = np.abs(np.fft.fftfreq(error.size, period) / frequency - 1.0)
        band = np.cos(0.5 * math.pi * np.clip(off / _AROUND - 1.0, 0.0, 1.0)) ** 2
        ends = round(_ENDS * error.size)
        amplitude = np.abs(np.fft.ifft(band * np.fft.fft(error)))[ends : error.size - ends]
        low, middle, high = np.quantile(amplitude, (0.25, 0.5, 0.75)).tolist()
        spreads.append((high - low) / middle if middle else 0.0)
    steadier = sorted(spreads)[: (len(spreads) + 1) // 2]
    return sum(steadier) > _COMES_AND_GOES * len(steadier)


def stick_slip(error: Array, period: float) -> bool:
    """Whether the platform stands and jumps: ``error`` (n,) in m of samples ``period`` s apart without a gap."""
    velocity = _relative_velocity(error, period)
    return _jumps(velocity) and float(_standing(velocity).mean()) >= _STANDS and not _in_bursts(velocity)


def _relative_velocity(error: Array, period: float) -> Array:
    """The velocity, relative to its RMS."""
    span = max(1, round(_VELOCITY_OVER / period))
    velocity = error[span:] - error[:-span]
    square = float(np.mean(velocity**2)) if velocity.size else 0.0
    return np.asarray(velocity / math.sqrt(square)) if square else velocity


def _jumps(velocity: Array) -> bool:
    return bool(velocity.size) and float(np.mean(velocity**4)) >= _JUMPS


def _standing(velocity: Array) -> NDArray[np.bool_]:
    return np.abs(velocity) < _STANDING


def _in_bursts(velocity: Array) -> bool:
    """Whether the platform stands less between two jumps to opposite sides than else: the loop oscillates now and
    then."""
    jumps, standing = np.flatnonzero(np.abs(velocity) > _JUMPING), _standing(velocity)
    back = np.flatnonzero(velocity[jumps[1:]] * velocity[jumps[:-1]] < 0.0)
    begins, ends = jumps[back] + 1, jumps[back + 1]
    stood = np.concatenate([[0], np.cumsum(standing)])
    between = (stood[ends] - stood[begins]) / np.maximum(1, ends - begins)
    return bool(between.size and between.mean() < _IN_BURSTS * standing.mean())


def of_map(
    x: Array, left: Array, deviations: Callable[[Array], Array], straightness: StraightnessMap | None = None
) -> str:
    """Why a map leaves ``left`` (n,) of its guide at ``x`` (n,), m, from the least squares line, and what to do.

    ``deviations`` are the map's over x; ``straightness`` knows its noise and its points.
    """
    some = np.linspace(0, x.size - 1, min(x.size, _PLACES)).astype(np.intp)
    x, left = x[some], left[some]
    own = deviations(x)
    shifts = np.arange(-_FARTHEST, _FARTHEST + 0.5 * _SHIFT, _SHIFT)
    found = [_unexplained(x, left, deviations(x + one) - own) for one in shifts.tolist()]
    best = int(np.argmin(found))
    factor, of_height = _fitted(x, left, own)
    bow, of_bow = _fitted(x, left, (x - x.mean()) ** 2)
    sagitta = abs(bow) * (0.5 * float(np.ptp(x))) ** 2 * 1e6
    height = "it has the opposite sign" if factor < -1.0 else f"its heights must be multiplied by {1.0 + factor:.3g}"
    least, cause = min(
        (found[best], f"its zero of x is off: shift its x by {-shifts[best] * 1e3:+.3g} mm"),
        (of_height, f"{height}: check its sign and unit"),
        (of_bow, f"it is bowed by {sagitta:.3g} µm: the straightedge was; separate it by straightcomp map reverse"),
    )
    if least <= _EXPLAINED:
        return f"the survey is not of this guide as it lies: {cause}"
    if straightness is not None:
        points = straightness.report.x
        away = np.abs(x[:, np.newaxis] - points).min(axis=1)
        room = 0.5 * float(np.median(np.diff(points)))
        near, far = away < 0.3 * room, away > 0.7 * room
        if np.count_nonzero(near) > 2 and far.any():
            # Relative to the points' own line: what is left between them may be to one side.
            apart = left - np.polyval(np.polyfit(x[near], left[near], 1), x)
            if float(np.mean(apart[near] ** 2)) < _EXPLAINED * float(np.mean(apart[far] ** 2)):
                return f"the guide bends between the survey's points, {2e3 * room:.4g} mm apart: survey more points"
        noise = straightness.noise
        if float(np.mean(left**2)) <= (2.0 * noise.half_width / NORMAL_95) ** 2:
            return f"{noise}: repeat its runs, and smooth it (stage.guide.smooth)"
    return "use a survey of this guide, and check its sign, unit and zero of x"


def _fitted(x: Array, left: Array, shape: Array) -> tuple[float, float]:
    """The factor of ``shape`` (n,) in ``left`` (n,), and the share of its square that then remains."""
    flat = least_squares_residual(x, shape)
    square = float(flat @ flat)
    factor = float(flat @ least_squares_residual(x, left)) / square if square else 0.0
    return factor, _unexplained(x, left, factor * shape)


def _unexplained(x: Array, left: Array, shape: Array) -> float:
    rest, whole = least_squares_residual(x, left - shape), least_squares_residual(x, left)
    return float(rest @ rest) / max(float(whole @ whole), np.finfo(float).tiny)


def dragging(motion: JudgedMotion) -> float:
    """Part of the current in A that opposes a cable's drag: it turns round with the travel of the stage, that against
    friction with the platform's. 0 unless the two can be distinguished, it outweighs the rest, and the error is made
    where the stage starts and stops, as that of an offset that drifts is not."""
    time, current, error = motion.time, motion.current, motion.error
    ways, ends = np.zeros(time.size), np.zeros(time.size, dtype=bool)
    for one in motion.strokes:
        ways[one.samples] = 1.0 if one.direction == "forward" else -1.0
        for end in (one.start, one.stop):
            ends[end : end + round(_AFTER / motion.period)] = True
    moving = np.flatnonzero(ways)
    if not moving.size or not np.ptp(ways[moving]):
        return 0.0
    velocity = np.sign(np.gradient(motion.r, time))
    if abs(float(np.mean(velocity[moving] * ways[moving]))) > _SAME_WAY:
        return 0.0
    # The cable's own slope is no rest: it grows with x.
    terms = np.column_stack([np.ones(time.size), motion.y, motion.x, velocity, ways])[moving]
    factors, *_ = np.linalg.lstsq(terms, current[moving], rcond=None)
    rest = float(np.std(current[moving] - terms @ factors))
    friction, drag = np.abs(factors[3:]).tolist()
    at_ends, elsewhere = (float(np.mean(error[mask] ** 2)) if mask.any() else 0.0 for mask in (ends, ~ends))
    return drag if drag > max(friction, rest) and at_ends > _AT_REVERSALS * elsewhere > 0.0 else 0.0


def of_error(motion: JudgedMotion) -> str:
    """Why an error is large that no line and no jumps make, and what to do."""
    # This import takes half a second.
    from scipy.ndimage import gaussian_filter1d

    x, error, strokes, period = motion.x, motion.error, motion.whole_strokes, motion.period
    grid = np.linspace(float(x.min()), float(x.max()), _PLACES)
    rows = [np.interp(grid, *_ascending(x[one.samples], error[one.samples])) for one in strokes]
    alike = np.atleast_2d(np.corrcoef(rows)) if rows else np.ones((0, 0))
    of_way = [[one.direction == way for one in strokes] for way in ("forward", "backward")]
    same_place = "it is the same at each place of x in every stroke: learning.learn takes it off"
    if any(sum(ours) > 1 and float(alike[np.ix_(ours, ours)][0].min()) > _REPEATS for ours in of_way):
        return same_place
    if locked_to_x(motion):
        return same_place
    step = max(1, round(_STEP / period))
    ways = np.sign(np.diff(motion.r[::step]))
    turns, way_of_r = np.flatnonzero(np.diff(ways))[:, np.newaxis] * step, np.repeat(ways, step)
    after = np.zeros(error.size, dtype=bool)
    after[np.minimum(turns + np.arange(round(_AFTER / period)), error.size - 1)] = True
    at_turns, elsewhere = (float(error[mask] @ error[mask]) / max(1, int(mask.sum())) for mask in (after, ~after))
    if at_turns > _AT_REVERSALS * elsewhere > 0.0:
        return (
            "it is made where the platform reverses: friction is not as described (stage.friction.coulomb, static); "
            "straightcomp friction BAG estimates it"
        )
    if np.ptp(way_of_r) and abs(np.corrcoef(error[: way_of_r.size], way_of_r)[0, 1]) > _WITH_MOTION:
        return (
            "it has the direction in which the platform moves: friction is not as described (stage.friction.coulomb, "
            "viscous); straightcomp friction BAG estimates it"
        )
    if float(gaussian_filter1d(error, _SLOW / period).var()) > _MOST * float(error.var()):
        return "it changes slowly: look for an offset of the amplifier that drifts, a cable that drags, or a tilt"
    resting = np.concatenate([rest - rest.mean() for rest in motion.resting()] or [error[:0]])
    if resting.size and float(np.mean(resting**2)) > _MOST**2 * float(error.var()):
        return "it is as large at rest: look for an offset of the amplifier that drifts, and for vibration"
    # The law answers to the rate of a force that is locked to x, which has the other sign on the way back.
    if all(map(any, of_way)) and float(np.abs(alike[np.ix_(*of_way)]).min()) > _REPEATS:
        return same_place
    velocities = [_relative_velocity(error[one.samples], period) for one in strokes]
    if velocities and all(map(_jumps, velocities)):
        if any(map(_in_bursts, velocities)):
            return (
                "it comes in bursts, as of a loop that is hardly stable: compare stage.platform.mass, stage.actuator, "
                "stage.rate and stage.drive.delay with the machine; straightcomp design finds gains for a description"
            )
        return (
            "it comes in jumps: friction is not as described (stage.friction.bristle_stiffness, static); straightcomp "
            "friction BAG estimates it"
        )
    return UNKNOWN


def _of_few_waves(along: Array, error: Array, near: float) -> Line:
    """The strongest line of ``error`` (n,) ``along`` a stroke, of a few waves and up to well beyond ``near``."""
    return _strongest(*_spectrum(along, error, near), _FEW_WAVES / float(np.ptp(along)), math.inf)


def _strongest(tried: Array, spectrum: Array, low: float, high: float) -> Line:
    """The strongest line of a :func:`_spectrum` from ``low`` to ``high``; of no amplitude if it has none there."""
    first, last = np.searchsorted(tried, (low, high)).tolist()
    inside = spectrum[first : last + 1]
    if not inside.size:
        return Line(0.0, low)
    best = int(inside.argmax())
    return Line(float(inside[best]), float(tried[first + best]))


def _ascending(x: Array, values: Array) -> tuple[Array, Array]:
    order = np.argsort(x, kind="stable")
    return x[order], values[order]


def _stands_out(along: Array, error: Array, at: float, least: float = 0.0) -> bool:
    """Whether ``error`` (n,) has a line of ``least`` m over ``along`` (n,) within the resolution of ``at``, and that is
    `_STANDS_OUT` above what is around it."""
    tried, spectrum = _spectrum(along, error, at)
    length = float(np.ptp(along))
    there = float(spectrum[np.abs(tried - at) * length <= 1.0].max())
    return there > max(least, _STANDS_OUT * _background(tried, spectrum, length, at))


def _background(tried: Array, spectrum: Array, length: float, at: float) -> float:
    """Median of a :func:`_spectrum` over ``length`` around a line ``at``, to half and three halves of it; infinite
    where the length has too few waves to distinguish the line from what is around it."""
    around = spectrum[(np.abs(tried - at) * length > 2.0) & (np.abs(tried / at - 1.0) < 0.5)]
    return float(np.median(around)) if around.size else math.inf


def _spectrum(along: Array, error: Array, near: float) -> tuple[Array, Array]:
    """The frequencies to well beyond ``near`` of lines of ``error`` (n,) over ``along`` (n,), and amplitudes in m."""
    length = float(np.ptp(along))
    # Sums in fine bins, so that positions that are no even grid have a fast transform.
    bins = math.ceil(_BINS * near * length) + 1
    place = np.rint((along - along.min()) * ((bins - 1) / length)).astype(np.intp)
    sums = np.bincount(place, error - error.mean(), bins)
    spectrum = np.asarray(np.abs(np.fft.rfft(sums, _FINER * bins)) * (2.0 / error.size), dtype=np.float64)
    return np.arange(spectrum.size, dtype=np.float64) * ((bins - 1) / (_FINER * bins * length)), spectrum
