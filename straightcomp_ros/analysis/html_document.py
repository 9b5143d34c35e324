"""A document of plots and tables: one HTML file that needs no network and can be printed."""

import math
from collections.abc import Sequence
from html import escape
from typing import Any

import plotly.graph_objects as go
from plotly.io import to_html
from plotly.offline import get_plotlyjs

# Okabe and Ito's palette: told apart with any colour vision, and by lightness on a black-and-white print.
BLACK, BLUE, VERMILION, GREEN, GREY = "#000000", "#0072B2", "#D55E00", "#009E73", "#A8A8A8"

_CONFIG = {"displaylogo": False, "responsive": True}

_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#111;max-width:1100px;margin:2em auto;padding:0 1em}
h1{font-size:1.5em;margin-bottom:.2em}h2{font-size:1.15em;margin-top:1.8em}
table{border-collapse:collapse;font-size:.9em}td,th{padding:.15em .8em .15em 0;border-bottom:1px solid #ddd;
text-align:left}td.n{text-align:right;font-variant-numeric:tabular-nums}.fail{color:#B00020;font-weight:600}
.columns{columns:2;column-gap:3em}.columns tr{break-inside:avoid}.note{color:#555}
th{vertical-align:bottom;line-height:1.15}td.n+td,th+th{padding-left:.2em}
.pair{display:grid;grid-template-columns:1fr 1fr;gap:0 1em}.pair>*{min-width:0}
.card{border-left:5px solid #D55E00;background:#fdf6f0;padding:.6em 1em;margin:1em 0;break-inside:avoid}
.card.well{border-color:#009E73;background:#f0faf6}.card p{margin:.2em 0}.card b{font-size:1.05em}
@page{margin:16mm 14mm}
@media print{.pair{display:block}body{margin:0;padding:0;max-width:none;font-size:9pt}h2,h3{break-after:avoid}
.plot>div{height:275px!important}
figure,.plot,tr{break-inside:avoid}.modebar,.modebar-container{display:none}}
"""

# A plot keeps the width that it was drawn with; paper is narrower than most windows: A4 without the margins above.
_SCRIPT = """
const plots=()=>[...document.querySelectorAll('.js-plotly-plot')];
addEventListener('beforeprint',()=>plots().forEach(plot=>{plot.dataset.height=plot.layout.height;
Plotly.relayout(plot,{width:670,height:Math.min(275,plot.layout.height),autosize:false})}));
addEventListener('afterprint',()=>plots().forEach(plot=>
Plotly.relayout(plot,{width:null,height:Number(plot.dataset.height),autosize:true})));
"""


def html_document(title: str, body: str) -> str:
    """The whole document; ``title`` is text, ``body`` HTML."""
    return f"""<!DOCTYPE html><html lang=en><head><meta charset=utf-8><title>{escape(title)}</title>
<style>{_STYLE}</style><script>{get_plotlyjs()}</script></head><body>
{body}<script>{_SCRIPT}</script></body></html>"""


def html_plot(figure: go.Figure, bar: bool = True) -> str:
    """A plot as a part of a document; ``bar``: with plotly's bar of tools."""
    config = _CONFIG if bar else {**_CONFIG, "displayModeBar": False}
    described = _without_markup(figure.to_plotly_json())
    return str(to_html(described, full_html=False, include_plotlyjs=False, config=config, validate=False))


def _without_markup(value: Any) -> Any:
    """A figure's description in which plotly takes no text for HTML: names of bags and faults may be any. Templates are
    written by this package, and have tags."""
    if isinstance(value, dict):
        return {key: one if key == "hovertemplate" else _without_markup(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_markup(one) for one in value]
    return escape(value, quote=False) if isinstance(value, str) else value


def line_figure(x: str, y: str) -> go.Figure:
    """An empty plot with titles of its axes."""
    figure = go.Figure()
    figure.update_layout(template="plotly_white", height=330, margin={"l": 70, "r": 20, "t": 45, "b": 50})
    figure.update_layout(legend={"orientation": "h", "y": 1.02, "yanchor": "bottom"}, xaxis_title=x, yaxis_title=y)
    return figure


def html_table(rows: Sequence[dict[str, Any]]) -> str:
    """Rows by heading; numbers to four digits, a dash for what is not there."""
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
