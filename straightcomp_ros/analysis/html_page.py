"""A page of plots and tables: one HTML file that needs no network and can be printed. Its HTML is in `page.html`."""

import html
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape
from plotly.io import to_html
from plotly.offline import get_plotlyjs

from straightcomp_ros.analysis.figure_words import heading

_NUMBER = re.compile(r"(\(?-?\d+(\.\d+)?\)?|\?)$")


def _shown(value: Any) -> Any:
    """A number to four digits, a dash for what is not there, a text as it is."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else value


def _numeric(rows: Sequence[dict[str, Any]]) -> set[str]:
    """The headings of the columns that hold numbers, or nothing; or nothing but texts of numbers."""
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    return {
        name
        for name, values in columns.items()
        if any(not isinstance(one, str | bool) for one in values)
        or all(isinstance(one, str) and _NUMBER.match(one) for one in values)
    }


def with_code(text: Any) -> Markup:
    """A text with commands between backticks."""
    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text))))


def worded(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of figures by name, with words and units in place of the names."""
    # A column is narrow.
    return [{heading(name).removeprefix("compensation "): value for name, value in row.items()} for row in rows]


def _plot(figure: go.Figure) -> Markup:
    """As a part of a page."""
    config = {"responsive": True, "displayModeBar": False}
    described = _without_markup(figure.to_plotly_json())
    return Markup(to_html(described, full_html=False, include_plotlyjs=False, config=config, validate=False))


def _without_markup(value: Any) -> Any:
    """A figure's description in which Plotly takes no text for HTML: names of bags and faults may be any. Templates are
    written by this package, and have tags."""
    if isinstance(value, dict):
        return {key: one if key == "hovertemplate" else _without_markup(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_markup(one) for one in value]
    return html.escape(value, quote=False) if isinstance(value, str) else value


_ENVIRONMENT = Environment(
    loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, auto_reload=False
)
_ENVIRONMENT.filters.update(shown=_shown, numeric=_numeric, code=with_code, plot=_plot)
blocks: Any = _ENVIRONMENT.get_template("page.html").module
"""The macros of `page.html`: ``table``, ``paragraph`` … each gives a `Markup`. They escape every text."""


def html_page(
    title: str, heading: str, note: str, sections: Iterable[tuple[str, str]], *, with_plots: bool = True
) -> str:
    """The whole page. ``title``, ``heading`` and the sections' titles are texts; ``note`` and the sections' contents
    are HTML; a section without content is left out. ``with_plots`` embeds Plotly, 4 MB."""
    return str(blocks.page(title, heading, note, sections, Markup(get_plotlyjs()) if with_plots else ""))


def line_figure(x: str, y: str) -> go.Figure:
    """An empty plot with titles of its axes."""
    figure = go.Figure()
    figure.update_layout(template="plotly_white", height=270, margin={"l": 70, "r": 20, "t": 35, "b": 45})
    # The page's own colour behind it, light or dark, and its type.
    figure.update_layout(
        paper_bgcolor="rgba(0,0,0,0)", plot_bgcolor="rgba(0,0,0,0)", font_family="system-ui, sans-serif"
    )
    figure.update_layout(legend={"orientation": "h", "y": 1.02, "yanchor": "bottom"}, xaxis_title=x, yaxis_title=y)
    return figure
