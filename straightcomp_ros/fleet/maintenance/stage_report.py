"""The report of a stage's months: one HTML file, the advice with its evidence first."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from straightcomp_ros.analysis.html_page import blocks, html_page, html_plot
from straightcomp_ros.analysis.judgement import IN_ORDER
from straightcomp_ros.fleet.maintenance.advice import Advice, advice_of
from straightcomp_ros.fleet.maintenance.day_levels import BASELINE, BY_NAME, ERROR_BINS, WATCHED, DayLevels, day_levels
from straightcomp_ros.fleet.maintenance.history_plots import evidence, faults_over_time, history_plot, over_time
from straightcomp_ros.fleet.maintenance.level_change import LevelChange, trend_of

if TYPE_CHECKING:
    import pyarrow

_SHOWN = 20
"""Bags in a list."""
_TREND_DAYS = 91
"""Trends are those of the last quarter."""


def stage_report(stage: str, strokes: pyarrow.Table) -> str:
    """The page of a stage, from its strokes in the order of their start, at least one."""
    levels = day_levels(strokes)
    advice = advice_of(levels)
    begin, end = levels.date(0), levels.date(-1)
    count = f"{strokes.num_rows} strokes on {len(levels.day)} days, {begin} to {end}"
    changes: dict[str, list[LevelChange]] = {name: [] for name in levels.figures}
    for change in (change for one in advice for change in one.changes):
        changes[change.figure].append(change)
    plots = [
        html_plot(history_plot(levels, name, changes[name]), bar=False)
        for name, values in levels.figures.items()
        if np.count_nonzero(np.isfinite(values)) > 1
    ]
    faults = faults_over_time(strokes["start"].to_pylist(), strokes["faults"].to_pylist())
    slopes = blocks.paragraph("Median of all slopes between weeks (Theil and Sen) with its 95 % interval.")
    drawn = [
        ("Error r − y over x and time, by the encoder", over_time(levels, levels.profiles[ERROR_BINS])),
        ("Change of the guide over x and time, by the displacement sensor", over_time(levels, levels.shifts)),
    ]
    sections = [
        _advice(levels, advice),
        *((title, blocks.plots([html_plot(figure)])) for title, figure in drawn if figure is not None),
        ("Figures from day to day", blocks.plots(plots, "pair")),
        ("Trends of the last quarter", blocks.table(_trends(levels, changes)) + slopes),
        ("Faults over time", "" if faults is None else blocks.plots([html_plot(faults)])),
        *_bags(strokes),
    ]
    return html_page(f"{stage}, {begin} to {end}", f"Stage “{stage}”", blocks.paragraph(count), sections)


def _advice(levels: DayLevels, advice: list[Advice]) -> tuple[str, str]:
    """Title and content of the first section."""
    if len(levels.day) <= BASELINE:
        text = (
            f"{len(levels.day)} days with strokes: the first {BASELINE} make the baseline, changes are found after it"
        )
        return "", blocks.card("", text, True)
    if not advice:
        return "", blocks.card("Nothing changed.", "All figures are as in the first weeks.", True)
    cards = Markup("")
    for one in advice:
        others = ", ".join(BY_NAME[change.figure].words for change in one.changes[1:])
        note = f"found on {one.found}" + (f"; changed with it: {others}" if others else "")
        remedy = f"What helps: {one.remedy}." if one.due else "Nothing to do: it is back where it was."
        cards += blocks.card(one.text, remedy, not one.due, note, html_plot(evidence(levels, one), bar=False))
    return f"What needs attention: {sum(one.due for one in advice)}", cards


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
        more = blocks.paragraph(f"and {len(found) - _SHOWN} before") if len(found) > _SHOWN else ""
        yield f"{title}: {len(found)}", blocks.table(shown) + more
