"""What a person reads in place of a figure's name and value: words, the unit that ends the name, and digits."""

import re

_UNITS = {"um": "µm", "nm": "nm", "mm": "mm", "us": "µs", "ms": "ms", "s": "s", "A": "A", "Hz": "Hz", "deg": "°"}
_UNITS |= {"um_per_m": "µm/m", "1e-6": "1e-6"}
_WORDS = {
    "encoder_pp": "compensation error p-p, encoder",
    "encoder_rms": "compensation error RMS, encoder",
    "true_pp": "compensation error p-p, true",
    "true_rms": "compensation error RMS, true",
    "uncompensated_pp": "straightness p-p before (ISO 230-1)",
    "residual_pp": "straightness p-p after (ISO 230-1)",
    "residual_encoder_pp": "straightness p-p after, by map and encoder",
    "expected_samples": "samples expected",
    "received_samples": "samples received",
    "lost_samples": "samples lost",
    "lost_references": "samples without a reference",
    "lost_commands": "samples without a command",
    "control_activity": "sum of the control current's steps",
    "control_rms_step": "control current from sample to sample, RMS",
    "resting_rms_step": "control current from sample to sample at rest, RMS",
    "settling_median": "settling time, median",
    "settling_max": "settling time, longest",
    "standstill_pp": "motion at standstill p-p, largest",
    "reversal_pp": "error at a reversal p-p, largest",
    "stick_slip_events": "times of stick-slip",
    "saturated_samples": "samples at the current limit",
    "saturations": "times at the current limit",
    "amplifier_off_in_motion": "times the amplifier went off in motion",
    "expanded_uncertainty": "U (k = 2)",
    "correction_pp": "correction p-p",
    "map_uncertainty_95": "uncertainty of the map (95 %)",
    "map_uncertainty_95_twice_the_runs": "uncertainty of the map with twice the runs (95 %)",
    "found": "zero and sign are known",
    "lag": "lag, half of the shift between the directions",
    "middle": "middle of the survey, where the shift is",
    "unexplained_before_rms": "difference from the survey RMS, as it is",
    "unexplained_after_rms": "difference from the survey RMS, aligned",
    "phase": "phase margin",
    "gain_low": "the loop's gain may fall to, times",
    "gain_high": "the loop's gain may rise to, times",
}
_PARTS = (
    (r"^error_rms_(\d+)_(\d+)$", r"error RMS from \1 to \2 Hz"),
    (r"^straightness_(before|after)_(.*)_(forward|backward)$", r"straightness \1, \2, \3"),
    (r"^(before|after)_(.*)$", r"\1, \2"),
    (r"^latency_", "loop latency "),
    (r"^lateness_", "publication after the sample, "),
)
"""Patterns of names that have many members, and what they become."""


def in_words(name: str) -> tuple[str, str]:
    """Words and unit, which may be empty, of a figure such as ``encoder_pp_forward_um``."""
    if name.endswith("_95"):
        # The half width of the interval of the figure before it, with its unit.
        words, unit = in_words(name.removesuffix("_95"))
        return f"{words}, ± (95 %)", unit
    suffix = next((one for one in _UNITS if name.endswith(f"_{one}")), "")
    stem, unit = (name.removesuffix(f"_{suffix}"), _UNITS[suffix]) if suffix else (name, "")
    stem = stem.removesuffix("_Hz") if unit == "µm" else stem
    base, way = re.fullmatch(r"(.*?)(?:_(forward|backward))?", stem).groups()  # type: ignore[union-attr]
    if base in _WORDS:
        return _WORDS[base] + (f", {way}" if way else ""), unit
    for pattern, words in _PARTS:
        stem = re.sub(pattern, words, stem)
    return stem.replace("_", " "), unit


def with_digits(value: float, digits: int) -> str:
    """``value`` with so many digits behind the point, or two that count where these would show less of it."""
    return f"{value:.2g}" if 0.0 < abs(value) < 10.0 ** (1 - digits) else f"{value:.{digits}f}"


def heading(name: str) -> str:
    """Words and unit of a figure as the head of a column, or as a line's name."""
    words, unit = in_words(name)
    return f"{words} / {unit}" if unit else words
