"""The certificate as one HTML file that prints well and needs no network."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#111;max-width:900px;margin:2em auto;padding:0 1em}
h1{font-size:1.5em;margin-bottom:.2em}h2{font-size:1.15em;margin-top:1.6em;border-bottom:2px solid #0072B2}
table{border-collapse:collapse;font-size:.9em}th{text-align:left;vertical-align:bottom}
td,th{padding:.15em 1.2em .15em 0;border-bottom:1px solid #ddd;vertical-align:top}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}.note{color:#555}
code{font-size:.8em;overflow-wrap:anywhere}img{max-width:100%}
.bar{display:inline-block;height:.7em;background:#0072B2;vertical-align:middle}
.ok{color:#00704F;font-weight:600}.fail{color:#B00020;font-weight:600}@page{margin:16mm 14mm}
@media print{body{margin:0;padding:0;max-width:none;font-size:9pt}h2{break-after:avoid}tr,img{break-inside:avoid}}
"""
_UNITS = {"pp_um": "p-p [µm]", "rms_um": "RMS [µm]"}


def certificate_page(told: Mapping[str, Any], pictures: Mapping[str, Path]) -> str:
    """The document.

    Args:
        told: content of `certificate.json`.
        pictures: PNG files by caption; those that are not there are left out.
    """
    steps = told["steps"]

    def figures(step: str) -> Mapping[str, Any]:
        found: Mapping[str, Any] = steps.get(step, {}).get("figures", {})
        return found

    timing = figures("acceptance").get("timing", {})
    sections = (
        (
            "Steps",
            _table(("step", "finding"), ((name.replace("_", " "), one["sentence"]) for name, one in steps.items())),
        ),
        ("Figures and their limits", _checked(told["checks"])),
        ("Limits for later strokes", _later(told["later_limits"])),
        ("Where the error comes from", _budget(figures("design").get("budget", []), told["map_noise_um"])),
        ("What late commands cost", _timing(timing, figures("connection").get("latency_histogram", []))),
        ("Samples and readback", _signals(figures("connection"), figures("signs_and_scales"))),
        ("The machine as found", _machine(figures("identification").get("parameters", {}), told)),
        ("What the data cannot tell", _listed(figures("identification").get("untold", []))),
        ("Margins", _margins(figures("frequency_response"))),
        *((caption, _picture(path, caption)) for caption, path in pictures.items() if path.is_file()),
        ("Files", _table(("file", "SHA-256"), ((name, f"{sum_}") for name, sum_ in told["sha256"].items()), code=True)),
    )
    body = "".join(f"<section><h2>{title}</h2>{content}</section>" for title, content in sections if content)
    made_by = escape(", ".join(f"{name} {value}" for name, value in told["made_by"].items()))
    name, date = escape(told["stage"]), escape(told["date"])
    return (
        f"<!DOCTYPE html><html lang=en><head><meta charset=utf-8><title>{name}</title><style>{_STYLE}</style></head>"
        f"<body><h1>Stage “{name}”</h1><p class=note>Commissioned {date}; {made_by}</p>{body}</body></html>\n"
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[object]], code: bool = False) -> str:
    """A table; numbers, and what stands in their column, are set right. With ``code`` the last column is code."""

    def cell(value: object, right: bool, last: bool) -> str:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return f"<td class=n>{value:.4g}</td>"
        text = escape(str(value))
        return f"<td{' class=n' if right else ''}>{f'<code>{text}</code>' if code and last else text}</td>"

    lines = [list(row) for row in rows]
    if not lines:
        return ""
    numbers = [isinstance(value, (int, float)) for value in lines[0]]
    heads = "".join(f"<th{' class=n' if n else ''}>{escape(one)}</th>" for one, n in zip(head, numbers, strict=True))
    body = "".join(
        f"<tr>{''.join(cell(value, numbers[index], index == len(row) - 1) for index, value in enumerate(row))}</tr>"
        for row in lines
    )
    return f"<table><tr>{heads}</tr>{body}</table>"


def _checked(checks: Sequence[Mapping[str, Any]]) -> str:
    rows = "".join(
        f"<tr><td>{escape(one['name'])}</td><td class=n>{one['value']:.4g}</td><td>{escape(one['allowed'])}</td>"
        f"<td class={'ok' if one['passed'] else 'fail'}>{'within' if one['passed'] else 'beyond'}</td></tr>"
        for one in checks
    )
    head = "<tr><th>figure</th><th class=n>measured</th><th>allowed</th><th></th></tr>"
    return f"<table>{head}{rows}</table>" if rows else ""


def _later(limits: Sequence[Mapping[str, Any]]) -> str:
    note = "<p class=note>In <code>limits.yaml</code>, for <code>straightcomp evaluate --limits</code>.</p>"
    rows = ((one["name"], one["value"], one["limit"]) for one in limits)
    table = _table(("figure", "this stroke", "later strokes: at most"), rows)
    return note + table if table else ""


def _budget(budget: Sequence[Mapping[str, Any]], map_noise_um: float) -> str:
    note = (
        "<p class=note>Simulated with the machine as found: what would be left if a cause were gone. The error of the "
        f"survey adds to each: {map_noise_um:.3g} µm RMS at each of its points "
        "(<code>stage.uncertainty.map_noise</code>). The platform follows it, and no encoder of this stage sees it.</p>"
    )
    table = _table(("machine", *_UNITS.values()), ([one["cause"], *(one[key] for key in _UNITS)] for one in budget))
    return note + table if table else ""


def _timing(timing: Mapping[str, Any], histogram: Sequence[Sequence[float]]) -> str:
    if not timing:
        return ""
    latency = timing["latency_us"]
    rows: list[Sequence[object]] = [
        ("the command acts after the sample [µs]", timing["due_us"]),
        *((f"latency {name} [µs]", value) for name, value in latency.items()),
        ("p-p with every command in time [µm]", timing["in_time_pp_um"]),
    ]
    if "p99_costs_um" in timing:
        rows += [
            ("latencies as measured cost [µm p-p]", timing["as_measured_costs_um"]),
            ("every command at the p99 would cost [µm p-p]", _or_lost(timing["p99_costs_um"])),
        ]
    rows += [
        ("longest stall of the host that is survived [ms]", timing["longest_stall_survived_ms"]),
        ("without commands the amplifier goes off after [ms]", timing["amplifier_off_after_ms"]),
    ]
    errors = ((stall, _or_lost(error)) for stall, error in timing["stall_error_um"].items())
    stalls = _table(("stall of the host", "largest error [µm]"), errors)
    return _table(("figure", "value"), rows) + "<br>" + stalls + "<br>" + _bars(histogram)


def _or_lost(error: float | None) -> object:
    """An error of a simulated stroke; JSON has no infinity, which says that the platform is lost."""
    return "lost" if error is None else error


def _signals(connection: Mapping[str, Any], readback: Mapping[str, Any]) -> str:
    names = (
        (connection, "rate_Hz", "samples per second", 1.0),
        (connection, "clock_drift_ppm", "drift of the samples' clock [ppm]", 1.0),
        (connection, "jitter_us", "jitter of the samples, RMS [µs]", 1.0),
        (connection, "count_y_nm", "smallest step of y at rest [nm]; 0: none", 1.0),
        (connection, "noise_y_counts", "noise of y at rest, RMS [counts]", 1.0),
        (connection, "noise_x_counts", "noise of x at rest, RMS [counts]", 1.0),
        (readback, "readback_gain", "readback of the current, relative to the command", 1.0),
        (readback, "readback_offset_A", "its offset [mA]", 1e3),
    )
    return _table(("figure", "measured"), ((words, scale * of[key]) for of, key, words, scale in names if key in of))


def _listed(sentences: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(one)}</li>" for one in sentences)
    return f"<ul>{items}</ul>" if items else ""


def _bars(histogram: Sequence[Sequence[float]]) -> str:
    if not histogram:
        return ""
    most = max(count for _, count in histogram)
    rows = "".join(
        f"<tr><td class=n>{edge:.0f}</td><td class=n>{count:.0f}</td>"
        f"<td><span class=bar style='width:{max(1.0, 300.0 * count / most):.0f}px'></span></td></tr>"
        for edge, count in histogram
    )
    return f"<table><tr><th class=n>latency up to [µs]</th><th class=n>commands</th><th></th></tr>{rows}</table>"


def _machine(parameters: Mapping[str, Mapping[str, Any]], told: Mapping[str, Any]) -> str:
    described, path = told["described"], told["current_path"]

    def interval(one: Mapping[str, Any]) -> str:
        if one["known"]:
            return "given, not found"
        return "hardly told by the record" if one["poor"] else f"{one['low']:.4g} to {one['high']:.4g}"

    rows = ((name, described.get(name, ""), one["value"], interval(one)) for name, one in parameters.items())
    current_path = (
        (name, one["described"], one["found"], f"{one['low']:.4g} to {one['high']:.4g}") for name, one in path.items()
    )
    return (
        _table(("parameter (SI)", "described", "found", "95 % interval"), rows)
        + "<br>"
        + _table(("current path", "described", "found", "range for which the law is designed"), current_path)
    )


def _margins(figures: Mapping[str, Any]) -> str:
    measured, model = figures.get("margins", {}), figures.get("model_margins", {})

    def shown(value: float | None) -> str:
        return "beyond the lines" if value is None else f"{value:.3g}"

    rows = ((name, shown(value), shown(model.get(name))) for name, value in measured.items())
    return _table(("margin", "measured", "model"), rows)


def _picture(path: Path, caption: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f"<img alt='{escape(caption)}' src='data:image/png;base64,{data}'>"
