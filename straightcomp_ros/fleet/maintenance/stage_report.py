"""The report of a stage's months: one HTML file, the advice with its evidence first."""

from __future__ import annotations

import re
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from straightcomp_ros.analysis.html_document import html_document, html_plot, html_table
from straightcomp_ros.analysis.judgement import IN_ORDER
from straightcomp_ros.fleet.maintenance import day_levels
from straightcomp_ros.fleet.maintenance.advice import Advice, advice_of, all_figures
from straightcomp_ros.fleet.maintenance.day_levels import BY_NAME, WATCHED, DayLevels
from straightcomp_ros.fleet.maintenance.history_plots import (
    error_map,
    evidence,
    faults_over_time,
    guide_map_over_time,
    history_plot,
)
from straightcomp_ros.fleet.maintenance.level_change import BASELINE, LevelChange, trend_of

if TYPE_CHECKING:
    import pyarrow

COLUMNS = (*day_levels.COLUMNS, "bag", "stroke", "verdict", "reason", "faults")
"""Columns of the store that :func:`stage_report` reads."""
_SHOWN = 20
"""Bags in a list."""
_TREND_DAYS = 91
"""Trends are those of the last quarter."""


def stage_report(stage: str, strokes: pyarrow.Table) -> str:
    """The document for a stage, from its strokes in the order of their start, at least one, with :data:`COLUMNS`."""
    levels = day_levels.day_levels(strokes)
    figures = all_figures(levels)
    advice = advice_of(levels)
    begin, end = levels.date(0), levels.date(-1)
    count = f"{strokes.num_rows} strokes on {len(levels.day)} days, {begin} to {end}"
    changes = {name: [change for one in advice for change in one.changes if change.figure == name] for name in figures}
    plots = [
        html_plot(history_plot(levels, values, name, changes[name]), bar=False)
        for name, values in figures.items()
        if np.count_nonzero(np.isfinite(values)) > 1
    ]
    parts = [
        f"<h1>Stage “{escape(stage)}”</h1><p class=note>{count}</p>",
        _advice(levels, advice),
        _over_x(levels),
        f"<section><h2>Figures from day to day</h2><div class=pair>{''.join(plots)}</div></section>",
        "<section><h2>Trends of the last quarter</h2>",
        html_table(_trends(levels, figures, changes)),
        "<p class=note>Median of all slopes between weeks (Theil and Sen) with its 95 % interval.</p></section>",
        _faults(strokes),
        *_bags(strokes),
    ]
    return html_document(f"{stage}, {begin} to {end}", "".join(parts))


def _advice(levels: DayLevels, advice: list[Advice]) -> str:
    if len(levels.day) <= BASELINE:
        text = (
            f"{len(levels.day)} days with strokes: the first {BASELINE} make the baseline, changes are told after that"
        )
        return f"<div class='card well'><p>{text}</p></div>"
    if not advice:
        return "<div class='card well'><p><b>Nothing changed.</b> All figures are as in the first weeks.</p></div>"
    cards = []
    for one in advice:
        others = ", ".join(BY_NAME[change.figure].words for change in one.changes[1:])
        also = f"; changed with it: {escape(others)}" if others else ""
        remedy = f"What helps: {_with_code(one.remedy)}." if one.due else "Nothing to do: it is back where it was."
        cards.append(
            f"<div class='card{'' if one.due else ' well'}'><p><b>{escape(one.text)}</b></p><p>{remedy}</p>"
            f"<p class=note>found on {one.found}{also}</p>{html_plot(evidence(levels, one), bar=False)}</div>"
        )
    return f"<h2>What needs somebody: {sum(one.due for one in advice)}</h2>{''.join(cards)}"


def _with_code(text: str) -> str:
    """HTML of a text that has commands between backticks."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", escape(text))


def _over_x(levels: DayLevels) -> str:
    plots = (
        ("Error r − y over x and time, by the encoder", error_map(levels)),
        ("Change of the guide over x and time, by the displacement sensor", guide_map_over_time(levels)),
    )
    return "".join(
        f"<section class=plot><h2>{title}</h2>{html_plot(figure)}</section>"
        for title, figure in plots
        if figure is not None
    )


def _faults(strokes: pyarrow.Table) -> str:
    figure = faults_over_time(strokes["start"].to_pylist(), strokes["faults"].to_pylist())
    return "" if figure is None else f"<section class=plot><h2>Faults over time</h2>{html_plot(figure)}</section>"


def _trends(levels: DayLevels, figures: Any, changes: dict[str, list[LevelChange]]) -> list[dict[str, Any]]:
    rows = []
    recent = levels.day > levels.day[-1] - _TREND_DAYS
    for watched in WATCHED:
        trend = trend_of(levels.day[recent], figures[watched.name][recent])
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


def _bags(strokes: pyarrow.Table) -> list[str]:
    columns = ["start", "bag", "stroke", "direction", "encoder_pp_um", "verdict", "reason", "faults"]
    rows = strokes.select(columns).to_pylist()
    faulty = [row for row in rows if row["faults"]]
    bad = [row for row in rows if row["verdict"] != IN_ORDER]
    largest = sorted(rows, key=lambda row: -row["encoder_pp_um"])[:_SHOWN]
    lists = (
        ("Strokes with faults", faulty[::-1], lambda row: ", ".join(row["faults"])),
        ("Strokes that were not in order", bad[::-1], lambda row: f"{row['verdict']}: {row['reason']}"),
        ("Bags to look at: the largest errors", largest, lambda row: row["verdict"]),
    )
    parts = []
    for title, found, words in lists:
        shown = [
            {
                "start": f"{row['start']:%Y-%m-%d %H:%M}",
                "bag": row["bag"],
                "stroke": row["stroke"],
                "direction": row["direction"],
                "error p-p / µm": row["encoder_pp_um"],
                "what": words(row),
            }
            for row in found[:_SHOWN]
        ]
        more = f"<p class=note>and {len(found) - _SHOWN} before</p>" if len(found) > _SHOWN else ""
        parts.append(f"<section><h2>{title}: {len(found)}</h2>{html_table(shown)}{more}</section>")
    return parts
