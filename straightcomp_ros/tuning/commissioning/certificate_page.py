"""The certificate as one HTML file that prints well and needs no network."""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from straightcomp_ros.analysis.html_page import blocks, html_page, with_code

_UNITS = {"pp_um": "p-p [µm]", "rms_um": "RMS [µm]"}
_LATER = "In `limits.yaml`, for `straightcomp evaluate --limits`."
_BUDGET = """\
Simulated with the machine as found: what would be left if a cause were gone. The error of the survey adds to each:
{:.3g} µm RMS at each of its points (`stage.uncertainty.map_noise`). The platform follows it, and no encoder of this
stage sees it."""
_SIGNALS = (
    ("rate_Hz", "samples per second", 1.0),
    ("clock_drift_ppm", "drift of the samples' clock [ppm]", 1.0),
    ("jitter_us", "jitter of the samples, RMS [µs]", 1.0),
    ("count_y_nm", "smallest step of y at rest [nm]; 0: none", 1.0),
    ("noise_y_counts", "noise of y at rest, RMS [counts]", 1.0),
    ("noise_x_counts", "noise of x at rest, RMS [counts]", 1.0),
    ("readback_gain", "readback of the current, relative to the command", 1.0),
    ("readback_offset_A", "its offset [mA]", 1e3),
)
_TIMING = {
    "as_measured_costs_um": "latencies as measured cost [µm p-p]",
    "p99_costs_um": "every command at the p99 would cost [µm p-p]",
    "longest_stall_survived_ms": "longest stall of the host that is survived [ms]",
    "amplifier_off_after_ms": "without commands the amplifier goes off after [ms]",
}


def certificate_page(content: Mapping[str, Any], pictures: Mapping[str, Path]) -> str:
    """The page.

    Args:
        content: of `certificate.json`.
        pictures: PNG files by caption; those that are not there are left out.
    """
    steps = content["steps"]

    def figures(step: str) -> Mapping[str, Any]:
        found: Mapping[str, Any] = steps.get(step, {}).get("figures", {})
        return found

    connection, identification = figures("connection"), figures("identification")
    measured = {**connection, **figures("signs_and_scales")}
    untold = identification.get("untold", [])
    drawn = [
        (caption, blocks.picture(base64.b64encode(path.read_bytes()).decode(), caption))
        for caption, path in pictures.items()
        if path.is_file()
    ]
    sections = [
        (
            "Steps",
            _table("step", "finding", [(name.replace("_", " "), one["sentence"]) for name, one in steps.items()]),
        ),
        (
            "Figures and their limits",
            _table(
                *("figure", "measured", "allowed", ""),
                [(one["name"], one["value"], one["allowed"], one["passed"]) for one in content["checks"]],
            ),
        ),
        (
            "Limits for later strokes",
            _table(
                *("figure", "this stroke", "later strokes: at most"),
                [(one["name"], one["value"], one["limit"]) for one in content["later_limits"]],
                note=_LATER,
            ),
        ),
        (
            "Where the error comes from",
            _table(
                *("machine", *_UNITS.values()),
                [(one["cause"], *map(one.get, _UNITS)) for one in figures("design").get("budget", [])],
                note=_BUDGET.format(content["map_noise_um"]),
            ),
        ),
        (
            "What late commands cost",
            _timing(figures("acceptance").get("timing", {}), connection.get("latency_histogram", [])),
        ),
        (
            "Samples and readback",
            _table("figure", "measured", [(label, measured[k] * unit) for k, label, unit in _SIGNALS if k in measured]),
        ),
        ("The machine as found", _machine(identification.get("parameters", {}), content)),
        ("What the data cannot tell", blocks.list(untold) if untold else ""),
        ("Margins", _margins(figures("frequency_response"))),
        *drawn,
        (
            "Files",
            _table("file", "SHA-256", [(name, with_code(f"`{digest}`")) for name, digest in content["sha256"].items()]),
        ),
    ]
    made_by = ", ".join(f"{name} {value}" for name, value in content["made_by"].items())
    note = blocks.paragraph(f"Commissioned {content['date']}; {made_by}")
    stage = content["stage"]
    return html_page(stage, f"Stage “{stage}”", note, sections, with_plots=False)


def _table(*head_and_rows: Any, note: str = "") -> str:
    """A table from its headings and, last, its rows; nothing without rows."""
    *head, rows = head_and_rows
    if not rows:
        return ""
    table: str = blocks.table([dict(zip(head, row, strict=True)) for row in rows])
    return (blocks.paragraph(note) if note else "") + table


def _timing(timing: Mapping[str, Any], histogram: Sequence[Sequence[float]]) -> str:
    if not timing:
        return ""

    def or_lost(error: float | None) -> object:
        """An error of a simulated stroke; JSON has no infinity, which says that the platform is lost."""
        return "lost" if error is None else error

    rows = [
        ("the command acts after the sample [µs]", timing["due_us"]),
        *((f"latency {name} [µs]", value) for name, value in timing["latency_us"].items()),
        ("p-p with every command in time [µm]", timing["in_time_pp_um"]),
        *((label, or_lost(timing[name])) for name, label in _TIMING.items() if name in timing),
    ]
    stalls = [(stall, or_lost(error)) for stall, error in timing["stall_error_um"].items()]
    most = max((count for _, count in histogram), default=1.0)
    bars = [(round(edge), round(count), blocks.bar(count / most)) for edge, count in histogram]
    return (
        _table("figure", "value", rows)
        + _table("stall of the host", "largest error [µm]", stalls)
        + _table("latency up to [µs]", "commands", "", bars)
    )


def _machine(parameters: Mapping[str, Mapping[str, Any]], content: Mapping[str, Any]) -> str:
    described = content["described"]

    def interval(one: Mapping[str, Any]) -> str:
        if one["known"]:
            return "given, not found"
        return "hardly identifiable" if one["poor"] else f"{one['low']:.4g} to {one['high']:.4g}"

    rows = [(name, described.get(name, ""), one["value"], interval(one)) for name, one in parameters.items()]
    path = [
        (name, one["described"], one["found"], f"{one['low']:.4g} to {one['high']:.4g}")
        for name, one in content["current_path"].items()
    ]
    return _table("parameter (SI)", "described", "found", "95 % interval", rows) + _table(
        "current path", "described", "found", "range for which the law is designed", path
    )


def _margins(figures: Mapping[str, Any]) -> str:
    model = figures.get("model_margins", {})

    def shown(value: float | None) -> str:
        return "beyond the lines" if value is None else f"{value:.3g}"

    rows = [(name, shown(value), shown(model.get(name))) for name, value in figures.get("margins", {}).items()]
    return _table("margin", "measured", "model", rows)
