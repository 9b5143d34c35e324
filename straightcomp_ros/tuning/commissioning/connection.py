"""Step `connection`: do samples come, all of them, at their rate, and how much noise is in them?"""

from typing import Any

import numpy as np

from straightcomp_ros.tuning.commissioning.machine import Array, Series
from straightcomp_ros.tuning.commissioning.outcome import Outcome, Work
from straightcomp_ros.tuning.commissioning.timing_budget import PERCENTILES

_LISTEN = 30.0
"""s."""
_FIRST_US, _STEP, _STEPS = 10.0, 1.25, 42
"""Of the histogram of latencies: up to 0.1 s."""
_TELLING, _COUNT_WITHIN = 4, 0.2
"""Different readings from which the count can be told, and its largest relative difference from the described one."""
_SLOW = 1e-3
"""Largest relative difference between the rate and the described one."""
_NOISY = 3.0
"""Largest RMS of y at rest, relative to the described noise and the rounding to a count."""
_LEAST_ARRIVED = 0.5
"""Least share of the samples before which a command arrived. A busy computer has some without: the driver tells only
the newest of the commands that arrived since the sample before."""
_ROUNDING = 0.5
"""Largest RMS of a reading between two counts, counts."""


def connection(work: Work) -> Outcome:
    """Listen with the amplifier off."""
    stage = work.stage
    series = work.machine.listen(_LISTEN)
    if len(series.stamps) < 2:
        return Outcome(
            False, f"{len(series.stamps)} samples in {_LISTEN:g} s; is the board powered, and its bus connected?"
        )
    steps = np.diff(series.stamps)
    rate = 1e9 / float(np.median(steps))
    taken = np.concatenate([[0], np.cumsum(np.maximum(1, np.round(steps * rate * 1e-9)).astype(np.int64))])
    expected = int(taken[-1]) + 1
    lost = expected - len(series.stamps)
    noise = float(np.std(series.y)) / stage.encoder.y_resolution
    slope, _ = np.polyfit(taken, (series.stamps - series.stamps[0]).astype(np.float64), 1)
    lost_commands = _lost_commands(series)
    figures: dict[str, Any] = {
        "samples": len(series.stamps),
        "lost_samples": lost,
        "lost_commands": lost_commands,
        "rate_Hz": rate,
        "clock_drift_ppm": (stage.rate * float(slope) * 1e-9 - 1.0) * 1e6,
        "jitter_us": float(np.std(steps)) * 1e-3,
        "latency_us": _latency(series),
        "latency_histogram": _histogram(series),
        "noise_y_counts": noise,
        "noise_x_counts": float(np.std(series.x)) / stage.encoder.x_resolution,
        "count_y_nm": _count(series.y) * 1e9,
    }
    if not np.isfinite(series.y).all() or not np.isfinite(series.x).all():
        return Outcome(False, "a reading is not a number; look at the encoders and their interface", figures)
    if abs(rate / stage.rate - 1.0) > _SLOW:
        sentence = f"{rate:.6g} samples per second; the description says {stage.rate} ('stage.rate')"
        return Outcome(False, sentence, figures)
    if lost:
        share = 100.0 * lost / expected
        return Outcome(
            False,
            f"{lost} of {expected} samples ({share:.2g} %) were lost; look at the bus: its load, its terminators, its "
            "error counters",
            figures,
        )
    if lost_commands:
        return Outcome(
            False,
            f"{lost_commands} of {len(series.stamps)} samples got no command; look at the controller's log, at what "
            "else this computer does, and at 'straightcomp doctor'",
            figures,
        )
    arrived = float(np.isfinite(series.latency).mean())
    if arrived < _LEAST_ARRIVED:
        return Outcome(
            False,
            f"commands arrived at the driver between {100.0 * arrived:.3g} % of the samples (allowed: >= "
            f"{100.0 * _LEAST_ARRIVED:g} %); is the controller active, and is this computer busy?",
            figures,
        )
    count, described = figures["count_y_nm"], stage.encoder.y_resolution * 1e9
    if np.unique(series.y).size >= _TELLING and abs(count / described - 1.0) > _COUNT_WITHIN:
        sentence = f"y comes in steps of {count:.4g} nm; the description says {described:.4g} nm"
        return Outcome(False, f"{sentence} ('stage.encoder.y_resolution')", figures)
    allowed = _NOISY * (stage.uncertainty.sensor_noise + _ROUNDING)
    if noise > allowed:
        sentence = (
            f"y moves by {noise:.2g} counts RMS with the amplifier off (allowed by 'stage.uncertainty.sensor_noise': "
            f"{allowed:.2g}); look at the encoder of y and its shield, and at what shakes the machine"
        )
        return Outcome(False, sentence, figures)
    latency = figures["latency_us"]
    late = f"commands after {latency['p50']:.0f} µs (p99 {latency['p99']:.0f} µs)"
    return Outcome(
        True,
        f"{len(series.stamps)} samples at {rate:.6g} Hz, none lost; {late}; noise {noise:.2g} counts",
        figures,
    )


def _lost_commands(series: Series) -> int:
    """Samples without a command, between the first and the last that have one.

    At the beginning the controller does not listen yet, and at the end commands are on their way. The latencies do not
    tell it: the driver tells only that of the newest command since the sample before, so that a late one would look
    like a lost one.
    """
    given = np.flatnonzero(np.isfinite(series.command))
    return int(given[-1] - given[0] + 1 - given.size) if given.size else len(series.stamps)


def _latency(series: Series) -> dict[str, float]:
    """Percentiles of the time from a sample until its command arrived, µs; none without commands."""
    told = series.latency[np.isfinite(series.latency)]
    return {f"p{p:g}": float(np.percentile(told, p)) * 1e6 for p in PERCENTILES} if told.size else {}


def _histogram(series: Series) -> list[list[float]]:
    """Rows of (latency in µs up to which, commands), each step a quarter more than the one before."""
    told = series.latency[np.isfinite(series.latency)] * 1e6
    if not told.size:
        return []
    edges = np.geomspace(_FIRST_US, _FIRST_US * _STEP**_STEPS, _STEPS + 1)
    counts, _ = np.histogram(np.clip(told, edges[0], edges[-1]), edges)
    return [[float(edge), int(count)] for edge, count in zip(edges[1:], counts, strict=True) if count]


def _count(readings: Array) -> float:
    """The smallest step between two readings, m; 0 if they are all the same."""
    steps = np.abs(np.diff(np.unique(readings)))
    return float(steps.min()) if steps.size else 0.0
