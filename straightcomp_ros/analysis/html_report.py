"""The report of a run: one HTML file with interactive plots that needs no network and can be printed."""

import math
from collections.abc import Iterator, Sequence
from datetime import datetime, timezone

import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup
from numpy.typing import NDArray

from straightcomp_ros.analysis import html_page as page
from straightcomp_ros.analysis import style
from straightcomp_ros.analysis.assessment import Assessment, Interval, LimitCheck
from straightcomp_ros.analysis.figure_words import heading, with_digits
from straightcomp_ros.analysis.judged_motion import is_simulated
from straightcomp_ros.analysis.metrics import straightness_over
from straightcomp_ros.analysis.record import Array
from straightcomp_ros.analysis.straightness_statement import budget_rows
from straightcomp_ros.bags.information import origin
from straightcomp_ros.straightness.survey_header import Direction

_FIRST_YEAR = 2001
"""Stamps of this year and before are simulated time."""
_POINTS = 6000
"""Points that a curve is drawn with: each pixel column still shows its smallest and its largest value."""
_BINS = 200
_SHOWN = 40
"""Events in a list."""


def report_html(
    assessment: Assessment,
    other: Assessment | None = None,
    checks: Sequence[LimitCheck] = (),
    incident: tuple[Markup, Sequence[tuple[str, str]]] = (Markup(""), ()),
) -> str:
    """The page for ``assessment``, compared with the run ``other``, and with the ``checks`` of its limits; what is to
    be said first of an ``incident``, and its sections."""
    verdict, bag = assessment.verdict, str(assessment.bag)
    plots = (
        ("Straightness over the stroke, relative to the least squares line", _straightness(assessment)),
        ("What is left of it, enlarged", _straightness(assessment, before=False)),
        ("Compensation error", _error(assessment, other)),
        ("Spectrum of the error", _spectrum(assessment, other)),
        ("Control current", _current(assessment)),
        ("Loop timing", _timing(assessment)),
    )
    first = incident[0] + page.blocks.card(f"Verdict: {verdict}", _whose(assessment), verdict.in_order)
    first += Markup("").join(page.blocks.paragraph(text, "fail") for text in assessment.warnings)
    stated = page.worded(budget_rows(assessment.straightness))
    limits = [
        {"figure": heading(one.name), "value": one.value, "allowed": one.allowed, "": one.passed} for one in checks
    ]
    runs = {"this run": assessment.figures()} | ({} if other is None else {str(other.bag): other.figures()})
    figures = [{"figure": heading(name), **{run: runs[run][name] for run in runs}} for name in runs["this run"]]
    return page.html_page(
        bag,
        f"{'Incident' if incident[0] else 'Straightness compensation'}, law “{assessment.record.law}”",
        first,
        [
            *incident[1],
            ("Limits", page.blocks.table(limits)),
            *((title, page.blocks.plots([plot])) for title, plot in plots),
            ("Strokes", _strokes(assessment)),
            ("Straightness and its uncertainty (ISO 230-1)", page.blocks.table(stated)),
            *_events(assessment),
            ("Figures", page.blocks.table(figures, columns=other is None)),
        ],
    )


def _strokes(assessment: Assessment) -> Markup:
    """Error and straightness of each stroke, each a table that fits a sheet of paper."""
    tables = Markup("")
    for of_line in (False, True):
        rows = [
            {
                name: value
                for name, value in stroke.to_display().items()
                if name in ("direction", "start_s") or name.startswith(("before", "after")) == of_line
            }
            for stroke in assessment.strokes
        ]
        tables += page.blocks.table(page.worded(rows))
    return tables


def _whose(assessment: Assessment) -> str:
    """Bag, stage and machine, when the run began, and what made the report."""
    evaluation, made_by = assessment.evaluation, origin()
    driver = evaluation.parameters.get("driver", {})
    serial = f", serial number {driver['stage.serial']}" if driver.get("stage.serial") else ""
    machine = f"{'simulated' if is_simulated(driver) else 'real'} machine" if driver else "machine not recorded"
    # Stamps of simulated time have no date.
    began = datetime.fromtimestamp(evaluation.begin_ns * 1e-9, timezone.utc)
    date = f"; began {began:%Y-%m-%d %H:%M} UTC" if began.year > _FIRST_YEAR else ""
    stage = f"stage “{driver.get('stage.name', 'unknown')}”{serial}, {machine}{date}"
    by = f"{made_by['package']} {made_by['version']} ({made_by['revision']})"
    return f"{assessment.bag}: {stage}; report by {by}, {datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC"


def _straightness(assessment: Assessment, before: bool = True) -> go.Figure:
    record = assessment.record
    x, of_guide, after = straightness_over(record, assessment.evaluation.map or record.reference)
    seen = "map and encoder" if record.guide is None else "true"
    figure = page.line_figure("slider position x / mm", f"deviation / µm ({seen})")
    curves: tuple[tuple[str, Array, str, Direction | None], ...] = (
        ("before", of_guide, style.BLACK, None),
        ("after, forward", after, style.BLUE, "forward"),
        ("after, backward", after, style.VERMILION, "backward"),
    )
    for name, values, colour, direction in curves if before else curves[1:]:
        chosen = np.isin(record.motion.samples(), record.motion.samples(direction))
        if chosen.any():
            shown = values[chosen] * 1e6
            _curve(figure, x[chosen] * 1e3, shown, f"{name}: {with_digits(float(np.ptp(shown)), 2)} µm p-p", colour)
    return figure


def _errors(assessment: Assessment) -> tuple[Array, list[Array]]:
    """Time in s of the samples in motion, and their error in µm as the encoder sees it, and the true one if known."""
    moving = assessment.record.moving
    errors = (moving.r - moving.y, moving.true_error(assessment.record.reference))
    return moving.time, [error * 1e6 for error in errors if error is not None]


def _error(assessment: Assessment, other: Assessment | None) -> go.Figure:
    figure = page.line_figure("time / s", "error r − y / µm")
    time, errors = _errors(assessment)
    names = (("encoder", style.BLUE if len(errors) == 1 else style.GREY), ("true", style.BLUE))
    for (name, colour), values in zip(names, errors, strict=False):
        _curve(figure, time, values, name, colour)
    if other is not None:
        others_time, others = _errors(other)
        _curve(figure, others_time - others_time[0] + time[0], others[-1], str(other.bag), style.VERMILION)
    _mark(figure, assessment.amplifier_off, "amplifier off", style.VERMILION)
    _mark(figure, assessment.gaps, "samples lost", style.GREEN)
    return figure


def _spectrum(assessment: Assessment, other: Assessment | None) -> go.Figure:
    figure = page.line_figure("frequency / Hz", "amplitude density / (µm/√Hz)")
    for one, colour in ((assessment, style.BLUE), (other, style.VERMILION)):
        if one is not None and len(one.spectrum.density) > 1:
            density = np.sqrt(one.spectrum.density[1:]) * 1e6
            name = "this run" if one is assessment else str(one.bag)
            figure.add_scatter(x=one.spectrum.frequency[1:], y=density, name=name, line={"color": colour, "width": 1})
    figure.update_xaxes(type="log")
    # Powers of ten: a prefix such as µ would stand next to the µ of the unit.
    figure.update_yaxes(type="log", exponentformat="power")
    return figure


def _current(assessment: Assessment) -> go.Figure:
    moving = assessment.record.moving
    figure = page.line_figure("time / s", "control current / mA")
    _curve(figure, moving.time, moving.current * 1e3, "command", style.BLACK)
    _mark(figure, assessment.saturated, "at the current limit", style.VERMILION)
    return figure


def _timing(assessment: Assessment) -> go.Figure | None:
    evaluation = assessment.evaluation
    curves = (
        ("sample to command", evaluation.latency * 1e6, style.BLUE),
        ("sample to publication", evaluation.lateness * 1e6, style.VERMILION),
    )
    both = np.concatenate([values for _, values, _ in curves])
    if not len(both):
        return None
    # At least 1 µs wide: in a simulated run all samples take the same time.
    width = max(float(np.ptp(both)) / _BINS, 1.0)
    edges = both.min() - width / 2 + width * np.arange(math.ceil(np.ptp(both) / width) + 2)
    figure = page.line_figure("time / µs", "samples")
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


def _curve(figure: go.Figure, x: Array, y: Array, name: str, colour: str) -> None:
    kept = _extremes(y)
    figure.add_scatter(x=x[kept], y=y[kept], name=name, mode="lines", line={"color": colour, "width": 1})


def _extremes(values: Array) -> NDArray[np.intp]:
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


def _events(assessment: Assessment) -> Iterator[tuple[str, Markup]]:
    """A section for each kind of event."""
    intervals = {
        "Samples lost": assessment.gaps,
        "Command at the current limit": assessment.saturated,
        "Amplifier off while the stage moved": assessment.amplifier_off,
    }
    names = ("from / s", "to / s", "samples")
    events = {title: [dict(zip(names, one, strict=True)) for one in found] for title, found in intervals.items()}
    events["Stick-slip"] = [
        {"time / s": e.time, "x / mm": e.x * 1e3, "stuck / ms": e.duration * 1e3, "slip / µm": e.slip * 1e6}
        for e in assessment.stick_slips
    ]
    for title, rows in events.items():
        yield f"{title}: {len(rows)}", page.blocks.table(rows, most=_SHOWN)
