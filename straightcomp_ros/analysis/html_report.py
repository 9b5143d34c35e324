"""The report of a run: one HTML file with interactive plots that needs no network and can be printed."""

import math
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs

from straightcomp_ros.analysis.assessment import Assessment, Interval, LimitCheck, displayed_error
from straightcomp_ros.analysis.metrics import residual_over
from straightcomp_ros.straightness.survey import Direction

# Okabe and Ito's palette: told apart with any colour vision, and by lightness on a black-and-white print.
_BLACK, _BLUE, _VERMILION, _GREEN, _GREY = "#000000", "#0072B2", "#D55E00", "#009E73", "#A8A8A8"
_POINTS = 6000
"""Points that a curve is drawn with: each pixel column still shows its smallest and its largest value."""

_CONFIG = {"displaylogo": False, "responsive": True}
_BINS = 200

_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#111;max-width:1100px;margin:2em auto;padding:0 1em}
h1{font-size:1.5em;margin-bottom:.2em}h2{font-size:1.15em;margin-top:1.8em}
table{border-collapse:collapse;font-size:.9em}td,th{padding:.15em .8em .15em 0;border-bottom:1px solid #ddd;
text-align:left}td.n{text-align:right;font-variant-numeric:tabular-nums}.fail{color:#B00020;font-weight:600}
.columns{columns:2;column-gap:3em}.columns tr{break-inside:avoid}.note{color:#555}
th{vertical-align:bottom;line-height:1.15}td.n+td,th+th{padding-left:.2em}
@page{margin:16mm 14mm}
@media print{body{margin:0;padding:0;max-width:none;font-size:9pt}h2,h3{break-after:avoid}
.plot>div{height:275px!important}
figure,.plot,tr{break-inside:avoid}.modebar,.modebar-container{display:none}}
"""

# A plot keeps the width that it was drawn with; paper is narrower than most windows: A4 without the margins above.
_SCRIPT = """
const plots=()=>[...document.querySelectorAll('.js-plotly-plot')];
addEventListener('beforeprint',()=>plots().forEach(plot=>Plotly.relayout(plot,{width:670,height:275,autosize:false})));
addEventListener('afterprint',()=>plots().forEach(plot=>Plotly.relayout(plot,{width:null,height:330,autosize:true})));
"""


def report_html(assessment: Assessment, other: Assessment | None = None, checks: Sequence[LimitCheck] = ()) -> str:
    """The document for ``assessment``, compared with the run ``other``, and with the ``checks`` of its limits."""
    law = assessment.evaluation.record.law
    plots = (
        ("Straightness over the stroke, beside the least squares line", _straightness(assessment)),
        ("What is left of it, enlarged", _straightness(assessment, before=False)),
        ("Compensation error", _error(assessment, other)),
        ("Spectrum of the error", _spectrum(assessment, other)),
        ("Control current", _current(assessment)),
        ("Loop timing", _timing(assessment)),
    )
    sections = "".join(
        f"<section class=plot><h2>{title}</h2>"
        f"{figure.to_html(full_html=False, include_plotlyjs=False, config=_CONFIG)}</section>"
        for title, figure in plots
        if figure is not None
    )
    warnings = "".join(f"<p class=fail>{escape(text)}</p>" for text in assessment.warnings)
    bag = escape(str(assessment.bag))
    verdict = (
        f"<p class={'note' if assessment.verdict.in_order else 'fail'}>Verdict: {escape(str(assessment.verdict))}</p>"
    )
    return f"""<!DOCTYPE html><html lang=en><head><meta charset=utf-8><title>{bag}</title>
<style>{_STYLE}</style><script>{get_plotlyjs()}</script></head><body>
<h1>Straightness compensation, law “{escape(law)}”</h1><p class=note>{bag}</p>{verdict}{warnings}{_limits(checks)}
{sections}<h2>Strokes</h2>{_table([stroke.to_display() for stroke in assessment.strokes])}
{_events(assessment)}<h2>Figures</h2>{_figures(assessment, other)}<script>{_SCRIPT}</script></body></html>"""


def _straightness(assessment: Assessment, before: bool = True) -> go.Figure:
    record, motion = assessment.evaluation.record, assessment.motion
    x, y, guide, true = record.best_known(assessment.reference)
    seen = "true" if true else "map and encoder"
    moving = motion.samples()
    of_guide, after = (residual_over(x, values, record, motion) * 1e6 for values in (guide, guide + y))
    figure = _figure("slider position x / mm", f"deviation / µm ({seen})")
    curves: tuple[tuple[str, NDArray[np.float64], str, Direction | None], ...] = (
        ("before", of_guide, _BLACK, None),
        ("after, forward", after, _BLUE, "forward"),
        ("after, backward", after, _VERMILION, "backward"),
    )
    for name, values, colour, direction in curves if before else curves[1:]:
        chosen = np.isin(moving, motion.samples(direction))
        if chosen.any():
            label = f"{name}: {np.ptp(values[chosen]):.2f} µm p-p"
            _curve(figure, x[moving][chosen] * 1e3, values[chosen], label, colour)
    return figure


def _error(assessment: Assessment, other: Assessment | None) -> go.Figure:
    record = assessment.evaluation.record
    encoder, truth = displayed_error(assessment)
    window = assessment.motion.window
    figure = _figure("time / s", "error r − y / µm")
    _curve(figure, record.time[window], encoder[window] * 1e6, "encoder", _GREY if truth is not None else _BLUE)
    if truth is not None:
        _curve(figure, record.time[window], truth[window] * 1e6, "true", _BLUE)
    if other is not None:
        values, true_values = displayed_error(other)
        shown = values if true_values is None else true_values
        start = record.time[window.start]
        window = other.motion.window
        time = other.evaluation.record.time[window]
        _curve(figure, time - time[0] + start, shown[window] * 1e6, str(other.bag), _VERMILION)
    _mark(figure, assessment.amplifier_off, "amplifier off", _VERMILION)
    _mark(figure, assessment.gaps, "samples lost", _GREEN)
    return figure


def _spectrum(assessment: Assessment, other: Assessment | None) -> go.Figure:
    figure = _figure("frequency / Hz", "amplitude density / (µm/√Hz)")
    for one, colour in ((assessment, _BLUE), (other, _VERMILION)):
        if one is not None and len(one.spectrum.density) > 1:
            density = np.sqrt(one.spectrum.density[1:]) * 1e6
            name = "this run" if one is assessment else str(one.bag)
            figure.add_scatter(x=one.spectrum.frequency[1:], y=density, name=name, line={"color": colour, "width": 1})
    figure.update_xaxes(type="log")
    # Powers of ten: a prefix such as µ would stand beside the µ of the unit.
    figure.update_yaxes(type="log", exponentformat="power")
    return figure


def _current(assessment: Assessment) -> go.Figure:
    record, window = assessment.evaluation.record, assessment.motion.window
    figure = _figure("time / s", "control current / mA")
    _curve(figure, record.time[window], record.current[window] * 1e3, "command", _BLACK)
    _mark(figure, assessment.saturated, "at the current limit", _VERMILION)
    return figure


def _timing(assessment: Assessment) -> go.Figure | None:
    evaluation = assessment.evaluation
    curves = (
        ("sample to command", evaluation.latency * 1e6, _BLUE),
        ("sample to publication", evaluation.lateness * 1e6, _VERMILION),
    )
    both = np.concatenate([values for _, values, _ in curves])
    if not len(both):
        return None
    # At least 1 µs wide: in a simulated run all samples take the same time.
    width = max(float(np.ptp(both)) / _BINS, 1.0)
    edges = both.min() - width / 2 + width * np.arange(math.ceil(np.ptp(both) / width) + 2)
    figure = _figure("time / µs", "samples")
    most = 1
    for name, values, colour in curves:
        if len(values):
            counts = np.histogram(values, edges)[0]
            most = max(most, int(counts.max()))
            figure.add_bar(x=edges[:-1] + width / 2, y=counts, width=width, name=name, marker_color=colour, opacity=0.7)
    figure.update_layout(barmode="overlay")
    # From half a sample on: a single one must show.
    figure.update_yaxes(type="log", range=[math.log10(0.5), math.log10(2 * most)], dtick=1)
    return figure


def _figure(x: str, y: str) -> go.Figure:
    figure = go.Figure()
    figure.update_layout(template="plotly_white", height=330, margin={"l": 70, "r": 20, "t": 45, "b": 50})
    figure.update_layout(legend={"orientation": "h", "y": 1.02, "yanchor": "bottom"}, xaxis_title=x, yaxis_title=y)
    return figure


def _curve(figure: go.Figure, x: NDArray[np.float64], y: NDArray[np.float64], name: str, colour: str) -> None:
    kept = _extremes(y)
    figure.add_scatter(x=x[kept], y=y[kept], name=name, mode="lines", line={"color": colour, "width": 1})


def _extremes(values: NDArray[np.float64]) -> NDArray[np.intp]:
    """Indices of the smallest and largest value of each of several thousand equal pieces, in order."""
    size = -(-2 * len(values) // _POINTS)
    if size < 3:
        return np.arange(len(values))
    whole = len(values) // size * size
    pieces = values[:whole].reshape(-1, size)
    starts = np.arange(0, whole, size)
    extremes = starts + pieces.argmin(axis=1), starts + pieces.argmax(axis=1)
    kept: NDArray[np.intp] = np.unique(np.concatenate([*extremes, np.arange(whole, len(values))]))
    return kept


def _mark(figure: go.Figure, intervals: Sequence[Interval], name: str, colour: str) -> None:
    # More of them would fill the plot; the figures give their number.
    for number, interval in enumerate(intervals[:200]):
        text = {"annotation_text": name, "annotation_position": "top left"} if number == 0 else {}
        line = {"color": colour, "width": 1}
        figure.add_vrect(interval.start, interval.end, fillcolor=colour, opacity=0.3, line=line, **text)


def _limits(checks: Sequence[LimitCheck]) -> str:
    rows = [{"verdict": "passed" if one.passed else "FAILED", "limit": str(one)} for one in checks]
    return "<h2>Limits</h2>" + _table(rows).replace("<td>FAILED", "<td class=fail>FAILED") if rows else ""


def _events(assessment: Assessment) -> str:
    intervals = {
        "Samples lost": assessment.gaps,
        "Command at the current limit": assessment.saturated,
        "Amplifier off while the stage moved": assessment.amplifier_off,
    }
    events = {title: [interval._asdict() for interval in found] for title, found in intervals.items()}
    events["Stick-slip"] = [
        {"time_s": e.time, "x_mm": e.x * 1e3, "stuck_ms": e.duration * 1e3, "slip_um": e.slip * 1e6}
        for e in assessment.stick_slips
    ]
    shown = 40
    return "".join(
        f"<h2>{title}: {len(rows)}</h2>{_table(rows[:shown])}"
        + (f"<p class=note>and {len(rows) - shown} more</p>" if len(rows) > shown else "")
        for title, rows in events.items()
        if rows
    )


def _figures(assessment: Assessment, other: Assessment | None) -> str:
    runs = {"this run": assessment.figures()}
    if other is not None:
        runs[str(other.bag)] = other.figures()
    rows = [{"figure": name, **{run: runs[run][name] for run in runs}} for name in runs["this run"]]
    return f"<div{' class=columns' if other is None else ''}>{_table(rows)}</div>"


def _table(rows: Sequence[dict[str, Any]]) -> str:
    if not rows:
        return "<p class=note>none</p>"
    # Headings break at their underscores: a stroke has more figures than a page is wide.
    heading = "".join(f"<th>{escape(name).replace('_', '_<wbr>')}</th>" for name in rows[0])
    cells = [[f"<td{'' if isinstance(v, str) else ' class=n'}>{_number(v)}</td>" for v in row.values()] for row in rows]
    # The browser prints a head on each page.
    body = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
    return f"<table><thead><tr>{heading}</tr></thead>{body}</table>"


def _number(value: Any) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else escape(str(value))
