"""The report of a stage's months: one HTML file, the advice with its evidence first.

Its plots: a figure from day to day, a profile over x then and now, and over x and time; faults.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup

from straightcomp_ros.analysis.html_page import blocks, html_page, line_figure
from straightcomp_ros.analysis.judgement import IN_ORDER
from straightcomp_ros.analysis.metrics import LINES
from straightcomp_ros.analysis.record import Array
from straightcomp_ros.analysis.style import BLACK, BLUE, GREEN, GREY, VERMILION
from straightcomp_ros.fleet.maintenance.advice import Advice, advice_of
from straightcomp_ros.fleet.maintenance.day_levels import (
    BASELINE,
    BY_NAME,
    ERROR_BINS,
    GUIDE,
    WATCHED,
    DayLevels,
    day_levels,
    median_of,
)
from straightcomp_ros.fleet.maintenance.level_change import SLACK, WEEK, LevelChange, baseline_of, trend_of

if TYPE_CHECKING:
    import pyarrow

_LATEST = 20
"""Strokes whose straightness is shown."""
_SHOWN = 20
"""Bags in a list."""
_TREND_DAYS = 91
"""Trends are those of the last quarter."""
_SMALL, _MIDDLE, _HEIGHT = 230, 300, 360
_FAULT = 34
"""Height in pixels of a line of marks."""
_FAINT_NM = 20.0
"""Values that are less than this are pale: noise must not look like a matter."""


def stage_report(stage: str, strokes: pyarrow.Table) -> str:
    """The page of a stage, from its strokes in the order of their start, at least one."""
    levels = day_levels(strokes)
    advice = advice_of(levels)
    begin, end = levels.date(0), levels.date(-1)
    span = f"{begin} to {end}" if end > begin else f"{begin}"
    count = f"strokes: {strokes.num_rows}, days: {len(levels.day)}, {span}"
    changes: dict[str, list[LevelChange]] = {name: [] for name in levels.figures}
    for change in (change for one in advice for change in one.changes):
        changes[change.figure].append(change)
    plots = [
        history_plot(levels, name, changes[name])
        for name, values in levels.figures.items()
        if np.count_nonzero(np.isfinite(values)) > 1
    ]
    faults = faults_over_time(strokes["start"].to_pylist(), strokes["faults"].to_pylist())
    slopes = blocks.paragraph("Median of all slopes between weeks (Theil and Sen) with its 95 % interval.")
    trends = _trends(levels, changes)
    error, guide = (over_time(levels, profiles) for profiles in (levels.profiles[ERROR_BINS], levels.shifts))
    sections = [
        _advice(levels, advice),
        ("Error r − y over x and time, by the encoder", blocks.plots([error])),
        ("Change of the guide over x and time, by the displacement sensor", blocks.plots([guide])),
        ("Figures from day to day", blocks.plots(plots, "pair")),
        ("Trends of the last quarter", blocks.table(trends) + slopes if trends else ""),
        (f"Straightness (ISO 230-1) of the last {_LATEST} strokes", blocks.table(_straightness(strokes))),
        ("Faults over time", blocks.plots([faults])),
        *_bags(strokes),
    ]
    drawn_at_all = any("Plotly.newPlot" in content for _, content in sections)
    return html_page(f"{stage}, {span}", f"Stage “{stage}”", blocks.paragraph(count), sections, with_plots=drawn_at_all)


def _advice(levels: DayLevels, advice: list[Advice]) -> tuple[str, str]:
    """Title and content of the first section."""
    if len(levels.day) <= BASELINE:
        text = (
            f"days with strokes: {len(levels.day)}; the first {BASELINE} make the baseline, changes are found after it"
        )
        return "", blocks.card("", text, True)
    if not advice:
        return "", blocks.card("Nothing changed.", "All figures are as in the first weeks.", True)
    cards = Markup("")
    for one in advice:
        others = ", ".join(BY_NAME[change.figure].words for change in one.changes[1:])
        note = f"found on {one.found}" + (f"; changed with it: {others}" if others else "")
        remedy = f"What helps: {one.remedy}." if one.due else "Nothing to do: it is back where it was."
        cards += blocks.card(one.text, remedy, not one.due, note, evidence(levels, one))
    return f"What needs attention: {sum(one.due for one in advice)}", cards


def _straightness(strokes: pyarrow.Table) -> list[dict[str, Any]]:
    """For each direction and line the medians of the last strokes and of their expanded uncertainties."""
    last, rows = strokes.slice(max(0, strokes.num_rows - _LATEST)), list[dict[str, Any]]()
    directions = np.array(last["direction"].to_pylist())
    for direction, line in itertools.product(np.unique(directions).tolist(), LINES):
        row: dict[str, Any] = {"straightness": f"{direction}, {line.replace('_', ' ')}"}
        for when, part in itertools.product(("before", "after"), ("", "_U")):
            values = np.array(last[f"{when}_{line}{part}_um"].to_pylist(), np.float64)[directions == direction]
            known = values[np.isfinite(values)]
            row[f"{when}{' U (k = 2)' * bool(part)} / µm"] = float(np.median(known)) if known.size else None
        rows.append(row)
    return rows


def _trends(levels: DayLevels, changes: dict[str, list[LevelChange]]) -> list[dict[str, Any]]:
    rows = []
    recent = levels.day > levels.day[-1] - _TREND_DAYS
    for watched in WATCHED:
        trend = trend_of(levels.day[recent], levels.figures[watched.name][recent])
        if trend is None:
            continue
        percent = 100.0 / abs(trend.level) if trend.level else None
        rows.append(
            {
                "figure": watched.words,
                "level": trend.level,
                "unit": watched.unit,
                "change a month": trend.slope,
                "from": trend.low,
                "to": trend.high,
                "% a month": None if percent is None else trend.slope * percent,
                "trend": ("rises" if trend.slope > 0.0 else "falls") if trend.certain else "none that is certain",
                "alarm": "yes" if any(change.lasting for change in changes[watched.name]) else "",
            }
        )
    return rows


def _bags(strokes: pyarrow.Table) -> Iterator[tuple[str, str]]:
    columns = ["start", "bag", "stroke", "direction", "encoder_pp_um", "verdict", "reason"]
    rows = strokes.select(columns).to_pylist()
    lists = {
        # A stroke with a fault is among them; the reason names it, but where the clock jumped or files are lost.
        "Strokes that were not in order": [row for row in rows if row["verdict"] != IN_ORDER][::-1],
        "Bags to look at: the largest errors": sorted(rows, key=lambda row: -row["encoder_pp_um"])[:_SHOWN],
    }
    for title, found in lists.items():
        shown = [
            {
                "start (UTC)": f"{row['start']:%Y-%m-%d %H:%M}",
                "bag": row["bag"],
                "stroke": row["stroke"],
                "direction": row["direction"],
                "error p-p / µm": row["encoder_pp_um"],
                "what": f"{row['verdict'].replace('_', ' ')}: {row['reason']}",
            }
            for row in found
        ]
        yield f"{title}: {len(found)}", blocks.table(shown, most=_SHOWN)


def history_plot(levels: DayLevels, name: str, changes: Sequence[LevelChange]) -> go.Figure:
    """A figure from day to day, its baseline, and its changes."""
    watched, values = BY_NAME[name], levels.figures[name]
    title = f"{watched.words} / {watched.unit}" if watched.unit else watched.words
    figure = line_figure("", "")
    heading = {"text": title, "font": {"size": 14}, "x": 0.01, "y": 0.97}
    figure.update_layout(height=_SMALL, showlegend=False, title=heading, margin={"l": 70, "r": 10, "t": 32, "b": 30})
    figure.update_yaxes(tickformat=".4~g")
    days = [levels.date(place).isoformat() for place in range(len(levels.day))]
    figure.add_scatter(x=days, y=values, mode="markers", marker={"size": 3, "color": GREY}, name="day")
    weeks = [float(median_of(values[max(0, k - 3) : k + 4])) for k in range(values.size)]
    figure.add_scatter(x=days, y=weeks, mode="lines", line={"color": BLUE, "width": 1.5}, name="week")
    baseline = baseline_of(values, watched)
    if baseline is not None:
        low, high = (baseline.centre + sign * SLACK * baseline.sigma for sign in (-1.0, 1.0))
        figure.add_hrect(low, high, fillcolor=GREEN, opacity=0.12, line_width=0)
    for change in changes:
        for place, colour, dash in ((change.begin, BLACK, "dot"), (change.found, VERMILION, "solid")):
            figure.add_vline(days[place], line={"color": colour, "width": 1.2, "dash": dash})
    return figure


def evidence(levels: DayLevels, advice: Advice) -> go.Figure:
    """What speaks for the cause: the figure's history, or the guide's profiles."""
    first = advice.changes[0]
    if first.figure != GUIDE:
        figure = history_plot(levels, first.figure, [first])
        figure.update_layout(height=_MIDDLE)
        corner = {"xref": "paper", "yref": "paper", "x": 0.01, "y": 0.98, "showarrow": False}
        figure.add_annotation(text="green: baseline; dotted: began; red: alarm", **corner)
        return figure
    measured = levels.measured[levels.measured <= first.days[-1]]
    figure = line_figure("slider position x / mm", "change of the guide / µm")
    figure.update_layout(height=_MIDDLE)
    # From the baseline to the last days of the change, which are strongest.
    stops = np.linspace(WEEK, measured.size, 5).astype(int).tolist()
    weeks = [*(measured[stop - WEEK : stop].tolist() for stop in stops[:-1]), list(first.days)]
    for number, days in enumerate(weeks):
        newest = number == len(weeks) - 1
        figure.add_scatter(
            x=levels.x * 1e3,
            y=median_of(levels.shifts[days]),
            name=f"{levels.date(days[0])} to {levels.date(days[-1])}",
            mode="lines",
            line={"color": VERMILION if newest else BLUE, "width": 2.5 if newest else 1},
            opacity=1.0 if newest else 0.25 + 0.6 * number / len(weeks),
        )
    if advice.place is not None:
        figure.add_vrect(advice.place.first, advice.place.last, fillcolor=VERMILION, opacity=0.1, line_width=0)
    return figure


def faults_over_time(starts: Sequence[datetime], faults: Sequence[Sequence[str]]) -> go.Figure | None:
    """A mark for each stroke with a fault, over its start, in a line for each kind, the most frequent one on top; None
    without one. The axis is that of all strokes, so that a quiet month is seen to be quiet."""
    count = Counter(label for labels in faults for label in labels)
    if not count:
        return None
    figure = line_figure("", "")
    figure.update_layout(height=_FAULT * len(count) + 110, showlegend=False, margin={"l": 10, "b": 40})
    for label, times in reversed(count.most_common()):
        at = [start.isoformat() for start, labels in zip(starts, faults, strict=True) if label in labels]
        figure.add_scatter(
            x=at,
            y=[f"{label}: {times}"] * len(at),
            mode="markers",
            marker={"symbol": "line-ns-open", "size": 15, "color": VERMILION, "line": {"width": 1.5}},
            name=label,
            hovertemplate="%{x}: %{fullData.name}<extra></extra>",
        )
    figure.update_xaxes(type="date", range=[starts[0].isoformat(), starts[-1].isoformat()])
    figure.update_yaxes(automargin=True, range=[-0.6, len(count) - 0.4])
    return figure


def over_time(levels: DayLevels, profiles: Array) -> go.Figure | None:
    """Profiles (n, m) in µm over x and time, by weeks; None without two of them."""
    if np.count_nonzero(np.isfinite(profiles).any(axis=1)) < 2:
        return None
    week = (levels.day - levels.day[0]) // WEEK
    # Also weeks without strokes, which are empty: else the colours of their neighbours would reach over them.
    weeks = np.arange(week[-1] + 1)
    values = np.full((weeks.size, profiles.shape[1]), np.nan)
    for one in np.unique(week):
        values[one] = median_of(1e3 * profiles[week == one])
    largest = max(float(np.nanpercentile(np.abs(values), 99.5)), _FAINT_NM)
    figure = line_figure("", "slider position x / mm")
    figure.update_layout(height=_HEIGHT)
    figure.add_heatmap(
        x=np.datetime_as_string((levels.day[0] + WEEK * weeks).astype("datetime64[D]")).tolist(),
        y=levels.x * 1e3,
        z=values.T,
        zmin=-largest,
        zmax=largest,
        # Blue to vermilion through white: distinct with any colour vision.
        colorscale=[[0.0, BLUE], [0.5, "#FFFFFF"], [1.0, VERMILION]],
        colorbar={"title": "nm"},
        hovertemplate="%{x}, x = %{y} mm: %{z:.1f} nm<extra></extra>",
    )
    return figure
