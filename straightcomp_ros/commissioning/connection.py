"""Step `connection`: do samples come, all of them, at their rate, and how much noise is in them?"""

import numpy as np

from straightcomp_ros.commissioning.outcome import Outcome, Work

_LISTEN = 2.0
"""s."""
_SLOW = 1e-3
"""Largest relative difference between the rate and the described one."""
_NOISY = 3.0
"""Largest RMS of y at rest, relative to the described noise and the rounding to a count."""
_ROUNDING = 0.5
"""Largest RMS of a reading between two counts, counts."""


def connection(work: Work) -> Outcome:
    """Listen with the amplifier off."""
    stage = work.stage
    series = work.machine.listen(_LISTEN)
    expected = round(_LISTEN * stage.rate)
    if len(series.stamps) < 2:
        return Outcome(
            False, f"{len(series.stamps)} samples in {_LISTEN:g} s; is the board powered, and its bus connected?"
        )
    steps = np.diff(series.stamps)
    period_ns = float(np.median(steps))
    rate = 1e9 / period_ns
    lost = max(int(np.sum(np.maximum(np.round(steps / period_ns) - 1.0, 0.0))), expected - len(series.stamps))
    noise = float(np.std(series.y)) / stage.encoder.y_resolution
    figures = {
        "samples": len(series.stamps),
        "lost_samples": lost,
        "rate_Hz": rate,
        "jitter_us": float(np.std(steps)) * 1e-3,
        "noise_y_counts": noise,
        "noise_x_counts": float(np.std(series.x)) / stage.encoder.x_resolution,
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
    allowed = _NOISY * (stage.uncertainty.sensor_noise + _ROUNDING)
    if noise > allowed:
        sentence = (
            f"y moves by {noise:.2g} counts RMS with the amplifier off (allowed by 'stage.uncertainty.sensor_noise': "
            f"{allowed:.2g}); look at the encoder of y and its shield, and at what shakes the machine"
        )
        return Outcome(False, sentence, figures)
    return Outcome(True, f"{len(series.stamps)} samples at {rate:.6g} Hz, none lost; noise {noise:.2g} counts", figures)
