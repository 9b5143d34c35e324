"""Make the layouts that open our topics ready to look at: config/foxglove.json and config/plotjuggler.xml.

From the top of the repository:

    python -m scripts.make_layouts

What is shown is said once, here; names of topics and places of numbers in the messages come from the contract.
Foxglove names a number by its place in an array (`/encoder.position[1]`), PlotJuggler by the joint
(`/encoder/platform_y/position`; in a trajectory by places too). Where the graph runs in a namespace, put it before each
topic in the files.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import SubElement

from straightcomp_ros.contract import (
    COMMAND,
    CONTROLLER_STATE,
    DIAGNOSTICS,
    DISPLACEMENT,
    DRIVER_STATE,
    ENCODER,
    REFERENCE,
    TRUTH,
    Stream,
)
from straightcomp_ros.parameters.output_files import write_whole

# Okabe and Ito's palette: distinct with any colour vision.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000")
_RUN_S = 17.0
"""Length of a run in s, for the first look; both programs zoom out to the data by themselves."""

Number = tuple[Stream, str]


@dataclass(frozen=True)
class Plot:
    """A plot: title with unit, the numbers in it, the number that is its x axis (time if None), the range of y."""

    title: str
    numbers: Sequence[Number]
    low: float
    high: float
    over: Number | None = None


TABS: dict[str, Sequence[Plot]] = {
    "Run": (
        Plot("Reference and platform / m", [(REFERENCE, "r"), (ENCODER, "y")], -13e-6, 13e-6),
        Plot("Compensation error / m", [(CONTROLLER_STATE, "error")], -0.5e-6, 0.5e-6),
        Plot("Control current / A", [(COMMAND, "control_current"), (ENCODER, "coil_current")], -0.1, 0.1),
        Plot("Stage / m", [(ENCODER, "x")], 0.0, 1.8),
    ),
    "Law": (
        Plot("Sliding variable / (m/s)", [(CONTROLLER_STATE, "sliding_variable")], -1e-4, 1e-4),
        Plot(
            "Parts of the current / A",
            [(CONTROLLER_STATE, "equivalent_current"), (CONTROLLER_STATE, "switching_current")],
            -0.1,
            0.1,
        ),
        Plot("Disturbance / (m/s²)", [(CONTROLLER_STATE, "disturbance_estimate")], -0.5, 0.5),
        Plot(
            "Velocity and its reference / (m/s)",
            [(CONTROLLER_STATE, "velocity_estimate"), (REFERENCE, "r_dot")],
            -5e-5,
            5e-5,
        ),
    ),
    "Timing": (
        Plot("Sample to command / s", [(DRIVER_STATE, "command_latency")], 0.0, 2e-3),
        Plot("Sample to publication / s", [(DRIVER_STATE, "lateness")], 0.0, 1e-3),
        Plot("Age of the reference / s", [(CONTROLLER_STATE, "reference_age")], 0.0, 8e-3),
        Plot("Amplifier on", [(DRIVER_STATE, "enabled")], -0.1, 1.1),
    ),
    "Straightness": (
        Plot(
            "Guide and platform over x / m (simulated)",
            [(TRUTH, "guide_deviation"), (TRUTH, "true_y")],
            -13e-6,
            13e-6,
            (TRUTH, "true_x"),
        ),
        Plot("Platform over x / m (encoders)", [(ENCODER, "y")], -13e-6, 13e-6, (ENCODER, "x")),
        Plot("Displacement sensor / m (surveys)", [(DISPLACEMENT, "deviation")], -13e-6, 13e-6),
        Plot("Forces / N (simulated)", [(TRUTH, "friction_force"), (TRUTH, "magnetic_force")], -2.0, 2.0),
    ),
}


def foxglove() -> dict[str, Any]:
    """The layout as Foxglove (and Lichtblick) export and import it."""
    panels: dict[str, Any] = {}
    tabs = []
    for tab, plots in TABS.items():
        own = {f"Plot!{tab.lower()}{place}": _panel(plot) for place, plot in enumerate(plots)}
        panels |= own
        tabs.append({"title": tab, "layout": _column(list(own))})
    summary = "DiagnosticSummary!nodes"
    panels[summary] = {
        "topicToRender": DIAGNOSTICS,
        "minLevel": 0,
        "pinnedIds": [],
        "hardwareIdFilter": "",
        "sortByLevel": True,
    }
    tabs.append({"title": "Nodes", "layout": summary})
    panels["Tab!straightcomp"] = {"activeTabIdx": 0, "tabs": tabs}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": "Tab!straightcomp",
    }


def _panel(plot: Plot) -> dict[str, Any]:
    curve = {"enabled": True, "timestampMethod": "headerStamp"}
    return {
        "foxglovePanelTitle": plot.title,
        "paths": [
            {"value": _message_path(number), "label": number[1], "color": colour, **curve}
            for number, colour in zip(plot.numbers, _COLOURS, strict=False)
        ],
        "xAxisVal": "custom" if plot.over else "timestamp",
        **({"xAxisPath": {"value": _message_path(plot.over), "enabled": True}} if plot.over else {}),
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": plot.over is None,
        "sidebarDimension": 240,
    }


def _message_path(number: Number) -> str:
    stream, column = number
    index = stream.layout.columns.index(column)
    array = stream.layout.places[index][0]
    place = sum(other == array for other, _ in stream.layout.places[:index])
    points = ".points[0]" if stream is REFERENCE else ""
    return f"/{stream.topic}{points}.{array}[{place}]"


def _column(names: Sequence[str]) -> Any:
    """Panels below each other, of the same height: a mosaic of halves."""
    if len(names) == 1:
        return names[0]
    share = round(100.0 / len(names), 3)
    return {"direction": "column", "first": names[0], "second": _column(names[1:]), "splitPercentage": share}


def plotjuggler() -> ElementTree.Element:
    """The layout as PlotJuggler 3 saves and loads it."""
    root = ElementTree.Element("root")
    main = SubElement(root, "tabbed_widget", name="Main Window", parent="main_window")
    for tab, plots in TABS.items():
        container = SubElement(SubElement(main, "Tab", tab_name=tab, containers="1"), "Container")
        sizes = ";".join([f"{1.0 / len(plots):.6f}"] * len(plots))
        splitter = SubElement(container, "DockSplitter", orientation="-", count=str(len(plots)), sizes=sizes)
        for plot in plots:
            _add_plot(SubElement(splitter, "DockArea", name=plot.title), plot)
    SubElement(main, "currentTabIndex", index="0")
    SubElement(root, "use_relative_time_offset", enabled="1")
    for empty in ("Plugins", "customMathEquations", "snippets"):
        SubElement(root, empty)
    return root


def _add_plot(area: ElementTree.Element, plot: Plot) -> None:
    mode, right = ("XYPlot", 1.8) if plot.over else ("TimeSeries", _RUN_S)
    element = SubElement(area, "plot", mode=mode, style="Lines", flip_x="false", flip_y="false")
    SubElement(element, "range", left="0", right=f"{right:g}", bottom=f"{plot.low:g}", top=f"{plot.high:g}")
    SubElement(element, "limitY")
    for number, colour in zip(plot.numbers, _COLOURS, strict=False):
        series = _series(number)
        curves = {"curve_x": _series(plot.over), "curve_y": series} if plot.over else {}
        SubElement(element, "curve", name=f"{series} over x" if plot.over else series, color=colour, **curves)


def _series(number: Number) -> str:
    stream, column = number
    array, joint = stream.layout.places[stream.layout.columns.index(column)]
    if stream is REFERENCE:
        return f"/{stream.topic}/points[0]/{array}[0]"
    return f"/{stream.topic}/{joint}/{array}"


def make(directory: Path) -> None:
    """Write both files into ``directory``."""
    text = json.dumps(foxglove(), indent=1, ensure_ascii=False)
    write_whole(directory / "foxglove.json", text + "\n")
    root = plotjuggler()
    ElementTree.indent(root, " ")
    xml = ElementTree.tostring(root, encoding="unicode")
    write_whole(directory / "plotjuggler.xml", f"<?xml version='1.0' encoding='UTF-8'?>\n{xml}\n")


if __name__ == "__main__":
    make(Path(__file__).resolve().parent.parent / "config")
