"""Position, coil current and command of one unbroken stretch of a bag, without the truth, and the path of the current.

A first-order amplifier under the old command until the new one arrives, a time d after the sample, gives

    i[k+1] = u_new + (u_old − u_new) exp(−ω (T − d)) + (i[k] − u_old) exp(−ω T)

with bandwidth ω and period T. With ω known, the measured currents give d for each sample: latency jitters, and a late
command arrives after the next sample. If d hardly changes, ω follows from the regression of i[k+1] on i[k] and on all
commands that a delay of less than :data:`_LATEST` samples may leave in action: the record shows which of them act.

The regression is Huber's M-estimate, least squares that a few wild residuals hardly move. A command that comes late
once leaves a residual hundreds of times as large as the others. By plain least squares, ten of 20,000 move the
amplifier's bandwidth by a fifth. P. Huber, Robust Statistics, 1981, sections 7.6 and 7.8.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis import IdentificationError
from straightcomp_ros.analysis.record import Array
from straightcomp_ros.bags.reader import read_attachments, read_streams, set_back
from straightcomp_ros.bags.recorded_nodes import recorded_parameters
from straightcomp_ros.contract import COMMAND, ENCODER
from straightcomp_ros.hardware.can.can_parameters import CanParameters, WireParameters, shipped_wire
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.parameters.declaration import from_mapping, under


def readback_lag(bag: Path) -> int:
    """Samples; 0 where the bag does not say it. BagError if it cannot be read, ParameterError if the meaning of the
    board's signals is refused; its DBC file is not read."""
    driver = recorded_parameters(bag, read_attachments(bag)).get("driver", {})
    if driver.get("hardware") != "can":
        return 0
    if not driver.get("can.dbc"):
        return shipped_wire(bool(driver.get("can.fd", CanParameters.fd))).readback_lag
    return from_mapping(WireParameters, under("can.wire.", driver)).readback_lag


def advanced(current: Array, lag: int) -> Array:
    """``current`` (n,) moved to the samples at which it was measured; the last ones are not known yet: NaN."""
    return np.concatenate([current[lag:], np.full(lag, np.nan)])


SHORTEST, LONGEST = 2000, 60_000
"""Samples of a stretch: from a second to half a minute at 2 kHz; more would cost much and improve little."""
_MEAN = 0.01
"""s; over which positions are averaged before their changes are summed up: the flicker of a count from sample to sample
adds up to more than a motion."""
LEAST_TRAVEL = 2e-6
"""Travel of the platform in m below which it may only creep on its bristles."""
SWITCH_ON = 10
"""Samples after the switch-on that are left out, while the bias current rises."""


@dataclass(frozen=True, eq=False)
class Recording:
    """An unbroken stretch with the amplifier on; all arrays (n,), one entry for each sample."""

    period_ns: int  # of the samples
    x: Array  # encoder reading of the stage, m
    y: Array  # and of the platform
    current: Array  # measured control current of the coils, A
    command: Array  # commanded control current in answer to the sample, A
    total: int  # samples in the bag

    @property
    def duration(self) -> float:
        """Length of the stretch in s."""
        return len(self.y) * self.period_ns * 1e-9


def read_recording(bag: Path, least_travel: float = LEAST_TRAVEL) -> Recording:
    """The longest stretch of a bag in which the amplifier is on and no sample is missing; of more than :data:`LONGEST`
    samples those in which the platform moves most.

    Raises:
        BagError: the bag cannot be read.
        IdentificationError: a stream is missing, its stamps go back, the amplifier is never on long enough, or the
            platform moves by less than ``least_travel`` in m.
    """
    streams = read_streams(bag, {stream.topic: stream.layout for stream in (ENCODER, COMMAND)})
    for stream in (ENCODER, COMMAND):
        if stream.topic not in streams:
            raise IdentificationError(f"bag {bag}: has no messages on '{stream.topic}'; record driver and controller")
        if back := set_back(streams[stream.topic].stamp):
            text = f"the stamps on '{stream.topic}' go back by {back:.3g} s"
            raise IdentificationError(f"bag {bag}: {text}: its clock was set back in the run; record again")
    encoder, commands = (streams[stream.topic].by_stamp() for stream in (ENCODER, COMMAND))
    x, y, current = (encoder.columns[name] for name in ("x", "y", "coil_current"))
    current = advanced(current, readback_lag(bag))
    if not np.isfinite(current).any():
        raise IdentificationError(
            f"bag {bag}: the amplifier is off throughout (coil_current is NaN in all {len(current)} samples); "
            "record with the amplifier on"
        )
    steps = np.diff(encoder.stamp)
    period_ns = round(float(np.median(steps))) if steps.size else 0
    # The longest run of usable samples a period apart.
    usable = np.isfinite(current) & np.isfinite(y)
    broken = (steps > 1.5 * period_ns) | ~usable[:-1] | ~usable[1:]
    edges = np.flatnonzero(np.concatenate([[True], broken, [True]]))
    longest = int(np.argmax(np.diff(edges)))
    stop = int(edges[longest + 1])
    # At the start of the bag the amplifier may have been on for long, but nothing says so.
    start = min(int(edges[longest]) + SWITCH_ON, stop)
    if stop - start < SHORTEST:
        raise IdentificationError(
            f"bag {bag}: the longest stretch with the amplifier on and no sample lost has {stop - start} samples; "
            f"allowed: >= {SHORTEST}; record more strokes in one bag"
        )
    start += _busiest(y[start:stop], max(1, round(_MEAN * 1e9 / period_ns)))
    stretch = slice(start, min(stop, start + LONGEST))
    travel = float(np.ptp(y[stretch]))
    if travel < least_travel:
        raise IdentificationError(
            f"bag {bag}: nothing moves: the platform stays within {travel * 1e6:.2g} µm, the stage within "
            f"{float(np.ptp(x[stretch])) * 1e3:.3g} mm; allowed: platform >= {least_travel * 1e6:.2g} µm; move the "
            "stage"
        )
    # The command before replaces a missing one, as in the amplifier.
    before = np.searchsorted(commands.stamp, encoder.stamp[stretch], side="right") - 1
    command = np.where(before >= 0, commands.columns["control_current"][np.maximum(before, 0)], 0.0)
    return Recording(period_ns, x[stretch], y[stretch], current[stretch], command, len(steps) + 1)


def _busiest(y: Array, block: int) -> int:
    """Where in ``y`` (n,) the :data:`LONGEST` samples begin in which the means of ``block`` samples go the longest way.

    Of the platform, not of the stage: an excitation may move it while the stage stands.
    """
    means, length = y[: len(y) // block * block].reshape(-1, block).mean(axis=1), LONGEST // block
    way = np.cumsum(np.abs(np.diff(means, prepend=means[:1])))
    return block * int(np.argmax(way[length - 1 :] - way[: len(way) - length + 1])) if len(way) > length else 0


_TUNING = 1.345
"""Standard deviations from which a residual counts less: of normal residuals, 95 % of the information is used."""
_NORMAL = 0.6745
"""Median of the magnitude of a normal variable, in standard deviations."""
_ROUNDS, _SETTLED = 50, 1e-9


def huber_weights(residuals: Array, least: float) -> Array:
    """Weights (n,) of the squares of ``residuals``, 1 for most; ``least`` is the smallest standard deviation that is
    assumed, in their unit, greater than 0."""
    limit = _TUNING * max(least, float(np.median(np.abs(residuals))) / _NORMAL)
    return np.minimum(1.0, limit / np.maximum(np.abs(residuals), limit))


def robust_regression(terms: Array, wanted: Array, least: float) -> tuple[Array, float]:
    """Factors (m,) of ``terms`` (n, m) that give ``wanted`` (n,), and the standard deviation of residuals that theirs
    follow from; ``least`` as for `huber_weights`."""
    weights: Array = np.ones(len(wanted))
    found: Array = np.zeros(terms.shape[1])
    for _ in range(_ROUNDS):
        root, before = np.sqrt(weights), found
        found = np.asarray(np.linalg.lstsq(terms * root[:, None], wanted * root, rcond=None)[0])
        residuals = wanted - terms @ found
        weights = huber_weights(residuals, least)
        if np.abs(found - before).max() < _SETTLED:
            break
    return found, float(np.sqrt(np.mean((weights * residuals) ** 2)) / np.mean(weights == 1.0))


_EXPLAINED = 0.2
"""Largest residual of an accepted fit, as a fraction of the current's steps."""
_INSTANT = 1e9
"""Rate in rad/s of an amplifier without lag."""
_ACTED = 0.02
"""Share of its full effect in a period from which a command counts as having acted in it."""
_PERCENTILES = (5.0, 50.0, 95.0)
_LATEST = 3
"""Delays of a command that are looked for: less than so many samples, or than two more than are described."""
_USUAL = 0.99
"""Share of the samples that an accepted fit must explain; commands that are late now and then are in the others."""
_EXACT = 1e-4
"""Standard deviation of the residuals relative to the current's steps, below which they count as none."""


@dataclass(frozen=True, eq=False)
class CurrentPath:
    """Commands for an amplifier that starts each period from the measured current."""

    rate: float  # of the first-order amplifier, rad/s
    before: Array  # (n,) commanded current in A from each sample
    after: Array  # and from switch_ns after it
    switch_ns: NDArray[np.int64]
    delay: float  # median from a sample to its command's arrival, s; NaN if no amplifier explains the measured current
    rate_found: bool  # whether the rate comes from the record, or else from the parameters
    rate_deviation: float  # standard deviation of a rate from the record by its residuals, rad/s; else 0
    delay_spread: tuple[float, float]  # in s, a twentieth of the commands come before, and after; NaN with the delay


def current_path(recording: Recording, drive: DriveParameters) -> CurrentPath:
    """The current between the samples of ``recording``; the bandwidth of ``drive`` holds if the record gives none."""
    period = recording.period_ns * 1e-9
    converted = np.array([drive.converted(value) for value in recording.command.tolist()])
    latest = max(_LATEST, math.ceil(drive.delay) + 2)
    found = [
        (*_regression(recording.current, asked, period, latest), asked) for asked in (recording.command, converted)
    ]
    open_part, rate, deviation, usual, asked = min(found, key=lambda one: one[0])
    rate_found = open_part < _EXPLAINED
    if not rate_found:
        rate, deviation, usual, asked = 2.0 * math.pi * drive.bandwidth, 0.0, 0, converted
    before, after, switch, late, missed = _arrivals(recording.current, asked, rate, period, usual, latest)
    if _usual_rms(missed) > _EXPLAINED * float(np.diff(recording.current).std()):
        # Linear from sample to sample, in two steps.
        current, following = recording.current, np.append(recording.current[1:], recording.current[-1])
        before, after = 0.75 * current + 0.25 * following, 0.25 * current + 0.75 * following
        halves = np.full(len(current), recording.period_ns // 2)
        return CurrentPath(_INSTANT, before, after, halves, math.nan, False, 0.0, (math.nan, math.nan))
    # Small changes say little of their time.
    telling = np.abs(after - before) > 0.5 * np.abs(after - before).mean()
    soonest, delay, last = math.nan, math.nan, math.nan
    if telling.any():
        soonest, delay, last = np.percentile((switch + late * period)[telling], _PERCENTILES).tolist()
    switch_ns = np.round(switch * 1e9).astype(np.int64)
    return CurrentPath(rate, before, after, switch_ns, delay, rate_found, deviation, (soonest, last))


def _usual_rms(missed: Array) -> float:
    """RMS of ``missed`` (n,) in the usual samples. The first ones follow commands from before the stretch: in a quiet
    loop a single one of them may outweigh all others."""
    return float(np.sqrt(np.mean(np.sort(np.abs(missed))[: round(_USUAL * len(missed))] ** 2)))


def _regression(current: Array, asked: Array, period: float, latest: int) -> tuple[float, float, float, int]:
    """Residual as a fraction of the current's steps, inf if no amplifier fits; rate and its standard deviation, rad/s;
    whole samples of delay, fewer than ``latest``."""
    steps, last = float(np.diff(current).std()), len(current) - 1
    if not steps > 0.0:
        return math.inf, 0.0, 0.0, 0
    commands = [asked[latest - age : last - age] for age in range(latest + 1)]
    terms = np.stack([current[latest:last], *commands], axis=1)
    weights, spread = robust_regression(terms, current[latest + 1 :], _EXACT * steps)
    kept = float(weights[0])
    if not (0.0 < kept < 1.0 and abs(float(weights.sum()) - 1.0) < 0.05):
        return math.inf, 0.0, 0.0, 0
    # The youngest command that has acted within the period: of those before it, something is left.
    whole = int(np.argmax(np.cumsum(weights[1:]) > _ACTED * (1.0 - kept)))
    deviation = spread * math.sqrt(float(np.linalg.pinv(terms.T @ terms)[0, 0])) / (kept * period)
    left = _usual_rms(current[latest + 1 :] - terms @ weights)
    return left / steps, -math.log(kept) / period, deviation, whole


def _arrivals(
    current: Array, asked: Array, rate: float, period: float, usual: int, latest: int
) -> tuple[Array, Array, Array, NDArray[np.int64], Array]:
    """Old and new command in A, time of the change in s, samples by which it is late, residual in A; (n,) each.

    ``usual`` is by how many samples most commands are late, ``latest`` more than any.
    """
    n = len(current)
    following = np.append(current[1:], current[-1])
    keep = math.exp(-rate * period)
    best = (*np.zeros((3, n)), np.zeros(n, np.int64), np.full(n, np.inf))
    for late in sorted(range(latest), key=lambda late: abs(late - usual)):
        new = np.concatenate([np.full(late, asked[0]), asked[: n - late]])
        old = np.concatenate([new[:1], new[:-1]])
        change = old - new
        # The rest of the old command that is left after T − d: between keep (d = 0) and 1 (d = T).
        with np.errstate(divide="ignore", invalid="ignore"):
            left = (following - new - (current - old) * keep) / change
        left = np.clip(np.where(change != 0.0, left, keep), keep, 1.0)
        missed = following - (new + change * left + (current - old) * keep)
        answer = (old, new, period + np.log(left) / rate, np.full(n, late), missed)
        # The usual one, if it explains the step: another one does so at times by chance.
        better = np.abs(missed) < 0.5 * np.abs(best[4]) - 1e-12
        best = tuple(np.where(better, a, b) for a, b in zip(answer, best, strict=True))
    return best
