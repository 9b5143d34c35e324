"""Steps before a loop is closed: `connection`, with the amplifier off, and `signs_and_scales`, with open-loop currents.

`connection`: do samples come, all of them, at their rate, and how much noise is in them?

`signs_and_scales` finds the signs of current and force, the readback, amplifier and delay. First a quick random
current, which the platform's mass averages out: the readback answers, the platform does not. Then a slow ramp either
way, until friction gives way. The amplifier goes off as soon as the platform has moved some micrometres, so that
nothing has to be known of the magnets' negative stiffness.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from straightcomp_ros.analysis.current_path import huber_weights
from straightcomp_ros.control.excitation import ExcitationParameters
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.commissioning.machine import Array, Outcome, Series, Work

_LISTEN = 30.0
"""s."""
_FIRST_US, _STEP, _STEPS = 10.0, 1.25, 42
"""Of the histogram of latencies: up to 0.1 s."""
_READINGS, _COUNT_WITHIN = 4, 0.2
"""Different readings that show the encoder's count, and its largest relative difference from the described one."""
_SLOW = 1e-3
"""Largest relative difference between the rate and the described one."""
_NOISY = 3.0
"""Largest RMS of y at rest, relative to the described noise and the rounding to a count."""
_LEAST_ARRIVED = 0.5
"""Least share of the samples before which a command arrived. A busy computer has some without: the driver records only
the newest of the commands that arrived since the sample before."""
_ROUNDING = 0.5
"""Largest RMS of a reading between two counts, counts."""
_SHAKE, _SHAKE_STEPS = 0.005, 4.0
"""Random current: relative to the bias current, and steps of the D/A converter, whichever is more."""
_SHAKE_TIME = 0.25
_ENOUGH = 40
"""Samples of it that identify the readback."""
_RAMP_TIME = 2.0
_RAMP_SHARE = 0.5
"""Highest current of a ramp, relative to the highest current."""
_TRAVEL, _TRAVEL_COUNTS = 3e-6, 6.0
"""m and counts of the encoder, whichever is more: the platform leaves faster the farther it is, and has to coast."""
_FREE_TRAVEL = 3e-7
"""The same in m in a ramp, without dry friction: nothing but the viscous one brakes the platform then."""
_PULLED = 0.3
"""Share of the first breakaway current below which it was not the current that moved the platform."""
_GAIN_WITHIN = 0.05
_SILENT = 0.05
"""Gain of a readback that does not answer."""
_OFFSET = 0.03
"""Largest offset of a readback, relative to the bias current."""
TOLERANCE = 1.1
"""Factor beyond its range at which a fact is called wrong."""
_DELAY_WITHIN = 0.05
"""The same in samples, for a delay of which a factor says little or nothing."""
_HIGHEST_DELAY = next(one.maximum for one in declarations(DriveParameters) if one.name == "delay") or 0.0
_LONGEST = math.ceil(TOLERANCE * _HIGHEST_DELAY)
"""Samples of delay that are looked for: more than a description may have."""
_RATE_STEP = 0.5
_LOG_RATES = np.arange(math.log(0.005), math.log(50.0), _RATE_STEP)
"""Logarithms of the amplifier's rate times the period, where the search begins; it ends at the first and the last."""
_FASTEST = 5.0
"""Rate times the period from which samples show neither the rate nor the delay within a sample: e⁻⁵, 0.7 %, of a step
is left after a period, and the steps of a shake are some thousandths of the bias current."""
_EXACT = 1e-12
_ROUNDS, _SETTLED = 30, 1e-7
_LEAST = 1e-4
"""Standard deviation of the residuals relative to that of the current, below which they count as none."""
_UNEXPLAINED = 0.9
"""Share of the current from which no amplifier fits."""


def connection(work: Work) -> Outcome:
    """Record with the amplifier off."""
    stage = work.stage
    series = work.machine.listen(_LISTEN)
    samples = len(series.stamps)
    if samples < 2:
        return Outcome(False, f"{samples} samples in {_LISTEN:g} s; is the board powered, and its bus connected?")
    steps = np.diff(series.stamps)
    rate = 1e9 / float(np.median(steps))
    taken = np.concatenate([[0], np.cumsum(np.maximum(1, np.round(steps * rate * 1e-9)).astype(np.int64))])
    slope, _ = np.polyfit(taken, (series.stamps - series.stamps[0]).astype(np.float64), 1)
    noise, different = float(np.std(series.y)) / stage.encoder.y_resolution, np.unique(series.y)
    latency = latency_percentiles(series.latency)
    figures: dict[str, Any] = {
        "samples": samples,
        "lost_samples": int(taken[-1]) + 1 - samples,
        "lost_commands": _lost_commands(series),
        "rate_Hz": rate,
        "clock_drift_ppm": (stage.rate * float(slope) * 1e-9 - 1.0) * 1e6,
        "jitter_us": float(np.std(steps)) * 1e-3,
        "latency_us": latency,
        "latency_histogram": _histogram(series),
        "noise_y_counts": noise,
        "noise_x_counts": float(np.std(series.x)) / stage.encoder.x_resolution,
        "count_y_nm": float(np.diff(different).min()) * 1e9 if different.size > 1 else 0.0,
    }
    if wrong := _signal_fault(series, figures, stage):
        return Outcome(False, wrong, figures)
    late = f"commands after {latency['p50']:.0f} µs (p99 {latency['p99']:.0f} µs)"
    return Outcome(True, f"{samples} samples at {rate:.6g} Hz, none lost; {late}; noise {noise:.2g} counts", figures)


def _signal_fault(series: Series, figures: Mapping[str, Any], stage: StageParameters) -> str:
    """What is wrong with the samples of `connection`, which have these ``figures``; empty if nothing is."""
    samples, lost, lost_commands = (figures[name] for name in ("samples", "lost_samples", "lost_commands"))
    rate, noise, count = (figures[name] for name in ("rate_Hz", "noise_y_counts", "count_y_nm"))
    arrived, described = float(np.isfinite(series.latency).mean()), stage.encoder.y_resolution * 1e9
    allowed = _NOISY * (stage.uncertainty.sensor_noise + _ROUNDING)
    if not np.isfinite([series.x, series.y]).all():
        return "a reading is not a number; look at the encoders and their interface"
    if abs(rate / stage.rate - 1.0) > _SLOW:
        return f"{rate:.6g} samples per second; the description says {stage.rate} ('stage.rate')"
    if lost:
        return (
            f"{lost} of {samples + lost} samples ({100.0 * lost / (samples + lost):.2g} %) were lost; look at the bus: "
            "its load, its terminators, its error counters"
        )
    if lost_commands:
        return (
            f"{lost_commands} of {samples} samples got no command; look at the controller's log, at what else this "
            "computer does, and at 'straightcomp doctor'"
        )
    if arrived < _LEAST_ARRIVED:
        return (
            f"commands arrived at the driver between {100.0 * arrived:.3g} % of the samples (allowed: >= "
            f"{100.0 * _LEAST_ARRIVED:g} %); is the controller active, and is this computer busy?"
        )
    if noise > allowed:
        return (
            f"y moves by {noise:.2g} counts RMS, in steps of {count:.4g} nm, with the amplifier off (allowed by "
            f"'stage.uncertainty.sensor_noise': {allowed:.2g} counts of {described:.4g} nm); look at the encoder of y "
            "and its shield, and at what shakes or pulls the machine"
        )
    if np.unique(series.y).size >= _READINGS and abs(count / described - 1.0) > _COUNT_WITHIN:
        return (
            f"y comes in steps of {count:.4g} nm; the description says {described:.4g} nm "
            "('stage.encoder.y_resolution')"
        )
    return ""


def _lost_commands(series: Series) -> int:
    """Samples without a command, between the first and the last that have one.

    At the beginning the controller is not connected yet, and at the end commands are on their way. The latencies do not
    show it: the driver records only that of the newest command since the sample before, so that a late one would look
    like a lost one.
    """
    given = np.flatnonzero(np.isfinite(series.command))
    return int(given[-1] - given[0] + 1 - given.size) if given.size else len(series.stamps)


def latency_percentiles(latency: Array) -> dict[str, float]:
    """Percentiles of the times (n,) in s from a sample until its command arrived, µs; none without commands."""
    known = latency[np.isfinite(latency)]
    return {f"p{p:g}": float(np.percentile(known, p)) * 1e6 for p in (50.0, 99.0, 99.9, 100.0)} if known.size else {}


def _histogram(series: Series) -> list[list[float]]:
    """Rows of (latency in µs up to which, commands), each step a quarter more than the one before."""
    known = series.latency[np.isfinite(series.latency)] * 1e6
    edges = np.geomspace(_FIRST_US, _FIRST_US * _STEP**_STEPS, _STEPS + 1)
    counts, _ = np.histogram(np.clip(known, edges[0], edges[-1]), edges)
    return [[float(edge), int(count)] for edge, count in zip(edges[1:], counts, strict=True) if count]


def fastest_shown(period: float) -> float:
    """Bandwidth of an amplifier in Hz from which samples a ``period`` in s apart show only that it is so fast."""
    return _FASTEST / (2.0 * math.pi * period)


class CurrentReadback(NamedTuple):
    """The way from command to readback; without an amplifier that fits, bandwidth and delay are NaN. Of an amplifier
    from :func:`fastest_shown` on they are the least ones that the samples leave."""

    gain: float  # measured current per commanded current, at rest
    offset: float  # measured current without a command, A
    bandwidth: float  # of a first-order amplifier, Hz
    delay: float  # of a command, samples
    unexplained: float  # RMS of what such an amplifier leaves, relative to that of the steps of the current


def current_readback(series: Series, drive: DriveParameters, period: float) -> CurrentReadback:
    """The way in ``series``, whose commands must change at random; ``period`` of the samples in s.

    The current of each candidate amplifier is computed from the commands alone, so that a readback of few counts does
    no harm. Only its rate is searched: gain, delay within a sample, and offset follow by least squares.
    """
    known = np.isfinite(series.current[: series.left_at])
    asked, current = (column[: series.left_at][known] for column in (series.command, series.current))
    asked = np.array([drive.converted(command) for command in asked.tolist()])
    scale, root = max(1e-12, float(current.std())), np.ones(asked.size)

    def fitted(log_rate: float, whole: int) -> tuple[float, float, float, Array]:
        """Gain, offset in A, delay in samples from ``whole`` to one more, and residuals (n,) in A.

        With ω T = the rate and the delay's fraction p of a period, w being ``whole``,
        i[k+1] = a i[k] + (b − a) u[k−w−1] + (1 − b) u[k−w], a = exp(−ω T), b = exp(−ω T (1 − p)).
        """
        rate = math.exp(log_rate)
        kept = math.exp(-rate)
        late = [np.concatenate([np.zeros(age + 1), asked])[: asked.size] for age in (whole, whole + 1)]
        terms = np.stack([*(lfilter([1.0], [1.0, -kept], one) for one in late), np.ones(asked.size)], axis=1)
        factors, *_ = np.linalg.lstsq(terms * root[:, None], current * root, rcond=None)
        if factors[0] * factors[1] < 0.0:
            # Beyond a whole sample: at the nearer one.
            used = [int(abs(factors[1]) > abs(factors[0])), 2]
            factors = np.zeros(3)
            factors[used], *_ = np.linalg.lstsq(terms[:, used] * root[:, None], current * root, rcond=None)
        new, total = float(factors[0]), float(factors[0] + factors[1])
        share = 0.0 if total == 0.0 else new * (1.0 - kept) / total
        delay = whole + 1.0 + math.log(max(kept, 1.0 - share)) / rate
        return total / (1.0 - kept), float(factors[2]), delay, np.asarray(current - terms @ factors)

    def missed(log_rate: float, whole: int) -> float:
        return float(np.sum((root * fitted(log_rate, whole)[3] / scale) ** 2))

    def refined(whole: int, log_rates: Iterable[float]) -> tuple[float, float, int]:
        begin = min(log_rates, key=lambda log_rate: missed(log_rate, whole))
        bounds = (max(_LOG_RATES[0], begin - _RATE_STEP), min(_LOG_RATES[-1], begin + _RATE_STEP))
        found = minimize_scalar(missed, args=(whole,), bounds=bounds, method="bounded", options={"xatol": _EXACT})
        return float(found.fun), float(found.x), whole

    _, log_rate, whole = min(refined(whole, _LOG_RATES) for whole in range(_LONGEST))
    gain, offset, delay, left = fitted(log_rate, whole)
    for _ in range(_ROUNDS):
        root, before = np.sqrt(huber_weights(left, _LEAST * scale)), (log_rate, delay)
        # Late commands have moved it, perhaps beyond a whole sample.
        wholes = {min(_LONGEST - 1, max(0, math.floor(delay + side))) for side in (-0.5, 0.5)}
        _, log_rate, whole = min(refined(whole, [log_rate]) for whole in wholes)
        gain, offset, delay, left = fitted(log_rate, whole)
        if max(abs(log_rate - before[0]), abs(delay - before[1])) < _SETTLED:
            break
    bandwidth = math.exp(log_rate) / (2.0 * math.pi * period)
    if bandwidth > fastest_shown(period):
        bandwidth, (_, _, delay, _) = fastest_shown(period), fitted(math.log(_FASTEST), whole)
    unexplained = float(left.std()) / max(1e-12, float(np.diff(current).std()))
    if float(left.std()) > _UNEXPLAINED * scale or gain == 0.0:
        return CurrentReadback(gain, math.nan, math.nan, math.nan, unexplained)
    # Rounding may leave less than no delay.
    return CurrentReadback(gain, offset, bandwidth, max(0.0, delay), unexplained)


def signs_and_scales(work: Work) -> Outcome:
    """Shake, then push either way."""
    stage = work.stage
    travel = max(_TRAVEL, _TRAVEL_COUNTS * stage.encoder.y_resolution)
    current = max(_SHAKE * stage.actuator.bias_current, _SHAKE_STEPS * stage.drive.current_step)
    current = min(current, stage.highest_current)
    shaken = work.machine.play(
        ExcitationParameters(signal="shake", current=current, duration=_SHAKE_TIME, travel=travel)
    )
    if pulled := _pulled_away(shaken, stage, _ENOUGH):
        return Outcome(False, pulled)
    readback = current_readback(shaken, stage.drive, stage.period)
    figures: dict[str, Any] = {
        "readback_gain": readback.gain,
        "readback_offset_A": readback.offset,
        "amplifier_bandwidth_Hz": readback.bandwidth,
        "delay_samples": readback.delay,
    }
    if wrong := _readback_fault(readback, stage):
        return Outcome(False, wrong, figures)
    currents: list[float] = []
    moved, farthest, highest = [], 0.0, _RAMP_SHARE * stage.highest_current
    dry = stage.friction.static > 0.0
    if not dry:
        travel = max(_FREE_TRAVEL, _TRAVEL_COUNTS * stage.encoder.y_resolution)
    for signal in ("ramp_up", "ramp_down"):
        pushed = work.machine.play(
            ExcitationParameters(signal=signal, current=highest, duration=_RAMP_TIME, travel=travel)
        )
        # The second may be pulled on from where the first has left the platform.
        if not currents and (pulled := _pulled_away(pushed, stage, 1)):
            return Outcome(False, pulled, figures)
        # The answer to the sample itself may be zero already.
        currents.append(math.nan if pushed.left_at is None else float(pushed.command[max(0, pushed.left_at - 1)]))
        # Not later, where a platform on a flexure has swung back.
        moved.append(float(pushed.y[-1 if pushed.left_at is None else pushed.left_at] - pushed.y[0]))
        farthest = max(farthest, float(np.abs(pushed.y - pushed.y[0]).max()))
    figures |= {"breakaway_currents_A": currents, "farthest_um": farthest * 1e6}
    if wrong := _force_fault(currents, moved, stage):
        return Outcome(False, wrong, figures)
    # A reading at the stop may be a count short of it.
    if farthest > stage.platform.stop - stage.encoder.y_resolution:
        way = f"the platform coasted {farthest * 1e6:.3g} µm when the amplifier went off, as far as its stop"
        return Outcome(False, f"{way} ('stage.platform.stop'): hardly any friction braked it", figures)
    back = f" and {1e3 * currents[1]:.3g} mA" if moved[1] < 0.0 else " mA, and the magnets pull the platform on"
    moves, coasts = ("friction gives way", "") if dry else ("the platform moves", ", and without friction coasts on")
    if readback.bandwidth < fastest_shown(stage.period):
        least, found = "", {"drive.bandwidth": readback.bandwidth, "drive.delay": min(_HIGHEST_DELAY, readback.delay)}
    else:
        least, found = "at least ", {"drive.bandwidth": max(stage.drive.bandwidth, readback.bandwidth)}
    sentence = (
        f"readback {readback.gain:.4g} times the command, amplifier {least}{readback.bandwidth:.0f} Hz, delay {least}"
        f"{readback.delay:.2f} samples; {moves} at {1e3 * currents[0]:.3g}{back}; the platform moved at most "
        f"{farthest * 1e6:.0f} µm{coasts}"
    )
    return Outcome(True, sentence, figures, stage=found)


def _pulled_away(series: Series, stage: StageParameters, needed: int) -> str:
    """Why the series says too little of currents: the platform left within fewer samples of current than ``needed``;
    empty where it did not. At rest only friction holds it against the magnets' negative stiffness."""
    if series.left_at is None:
        return ""
    acting = np.flatnonzero(series.command[: series.left_at])
    samples = series.left_at - int(acting[0]) if acting.size else 0
    if samples >= needed:
        return ""
    return (
        f"the platform left within {samples} samples of hardly any current (needed: {needed}): the magnets do not "
        f"balance; look for a coil without current, and for a bias current that is not {stage.actuator.bias_current:g} "
        f"A in both; or move the platform from y = {series.y[0] * 1e6:.3g} µm to the middle, and hold it there until "
        "the amplifier is on; or raise 'stage.rate'"
    )


def _readback_fault(found: CurrentReadback, stage: StageParameters) -> str:
    ranges, drive = stage.uncertainty, stage.drive
    if abs(found.gain) < _SILENT:
        return (
            f"the measured current does not answer: it stays at {found.gain:.2g} times the commanded one; look at the "
            "readback, and whether the amplifier has its supply"
        )
    if found.gain < 0.0:
        return "the measured current runs against the command: the readback is wired backwards"
    if math.isnan(found.bandwidth) or found.unexplained > 0.5:
        return "the measured current does not follow the command like a first-order amplifier; look at the readback"
    if abs(found.gain - 1.0) > _GAIN_WITHIN:
        return (
            f"the readback shows {found.gain:.3g} times the commanded current; allowed: 1 ± {_GAIN_WITHIN:g}; look at "
            "the readback's scale and 'stage.drive.gain'"
        )
    if abs(found.offset) > _OFFSET * stage.actuator.bias_current:
        return (
            f"the readback shows {found.offset * 1e3:.3g} mA without a command; allowed: "
            f"±{_OFFSET * stage.actuator.bias_current * 1e3:.3g} mA; look at the zero of the readback, and at the bias "
            "currents of both coils"
        )
    factor = found.bandwidth / min(drive.bandwidth, fastest_shown(stage.period))
    if not 1.0 / (TOLERANCE * ranges.amplifier) <= factor <= TOLERANCE * ranges.amplifier:
        return (
            f"the amplifier has {found.bandwidth:.0f} Hz, {factor:.2g} times what is described; allowed by "
            f"'stage.uncertainty.amplifier': within a factor of {ranges.amplifier:g}; look at its tuning and its supply"
        )
    # One that is shorter than described makes no law less stable, and what was found replaces the description.
    latest = min(_HIGHEST_DELAY, ranges.longest_delay * drive.delay)
    if found.delay > latest * TOLERANCE + _DELAY_WITHIN:
        return (
            f"commands act {found.delay:.2f} samples after theirs; allowed by 'stage.drive.delay' and "
            f"'stage.uncertainty.longest_delay': up to {latest:.2g}; look at what buffers them between "
            "driver and board, or describe the delay"
        )
    return ""


def _force_fault(currents: list[float], moved: list[float], stage: StageParameters) -> str:
    expected = stage.friction.static / stage.actuator.current_stiffness
    if all(map(math.isnan, currents)):
        tried = _RAMP_SHARE * stage.highest_current
        return (
            f"{tried:.2g} A do not move the platform; friction should give way at {expected:.2g} A; look for a blocked "
            "platform, a coil without current, or an encoder of y that does not count; if that is more than was tried, "
            "raise 'stage.actuator.current_limit' and the converter's range"
        )
    first, second = map(abs, currents)
    if moved[0] > 0.0 and moved[1] > 0.0 and second < _PULLED * first:
        # Where the first push left it, the magnets pull harder than friction holds: the second shows nothing.
        return ""
    if moved[0] < 0.0 or moved[1] > 0.0:
        return (
            "a positive current moves the platform toward negative y: the coils or the encoder of y are wired backwards"
        )
    if any(map(math.isnan, currents)):
        side = "positive" if math.isnan(currents[0]) else "negative"
        return f"the platform moves one way only, not with {side} current: one coil carries no current"
    return ""
