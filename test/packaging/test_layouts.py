"""The layouts for Foxglove and PlotJuggler show what there is: every topic and number in them is in the contract."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from scripts import make_layouts
from straightcomp_ros.bags.topics import typestore
from straightcomp_ros.contract import DIAGNOSTICS, DISPLACEMENT, STREAMS

ROOT = Path(__file__).resolve().parents[2]
TOPICS = {f"/{stream.topic}": stream for stream in (*STREAMS, DISPLACEMENT)}


@pytest.fixture(scope="module")
def foxglove():
    return json.loads((ROOT / "config" / "foxglove.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def plotjuggler():
    return ElementTree.parse(ROOT / "config" / "plotjuggler.xml").getroot()


@pytest.fixture(scope="module")
def messages():
    """One message of each topic, as others decode it, from the sample bags."""
    found = {}
    for name in ("smc", "survey"):
        with Reader(ROOT / "bags" / name) as reader:
            for connection, _, data in reader.messages():
                if connection.topic not in found:
                    found[connection.topic] = typestore().deserialize_cdr(data, connection.msgtype)
                if len(found) == len(reader.connections):
                    break
    return found


def plots(layout):
    return [panel for name, panel in layout["configById"].items() if name.startswith("Plot!")]


def message_paths(layout):
    over = [panel["xAxisPath"]["value"] for panel in plots(layout) if "xAxisPath" in panel]
    return over + [path["value"] for panel in plots(layout) for path in panel["paths"]]


def followed(message, path):
    for name, place in re.findall(r"[./](\w+)(?:\[(\d+)\])?", path):
        message = getattr(message, name)
        if place:
            message = message[int(place)]
    return message


def test_the_files_are_those_that_the_script_makes(tmp_path):
    make_layouts.make(tmp_path)
    for name in ("foxglove.json", "plotjuggler.xml"):
        assert (tmp_path / name).read_text() == (ROOT / "config" / name).read_text(), "run scripts/make_layouts.py"


def test_every_path_in_foxglove_is_a_number_of_a_message_and_is_called_as_its_column(foxglove, messages):
    paths = message_paths(foxglove)
    assert len(paths) > 20
    for path in paths:
        topic, rest = re.fullmatch(r"(/\w+)(\..+)", path).groups()
        assert topic in TOPICS, path
        if topic in messages:
            assert isinstance(followed(messages[topic], rest), float | np.floating), path
    for path in (one for panel in plots(foxglove) for one in panel["paths"]):
        topic, array, place = re.fullmatch(r"(/\w+)(?:\.points\[0\])?\.(\w+)\[(\d+)\]", path["value"]).groups()
        layout = TOPICS[topic].layout
        columns = [c for c, (a, _) in zip(layout.columns, layout.places, strict=True) if a == array]
        assert columns[int(place)] == path["label"], path


def test_every_panel_of_foxglove_is_placed_once_and_configured(foxglove):
    def placed(layout):
        return [layout] if isinstance(layout, str) else placed(layout["first"]) + placed(layout["second"])

    tabs = foxglove["configById"][foxglove["layout"]]["tabs"]
    names = [name for tab in tabs for name in placed(tab["layout"])]
    assert sorted([*names, foxglove["layout"]]) == sorted(foxglove["configById"])
    assert foxglove["configById"]["DiagnosticSummary!nodes"]["topicToRender"] == DIAGNOSTICS


def test_every_curve_in_plotjuggler_is_a_number_of_the_contract_and_every_stream_is_shown_in_both(
    foxglove, plotjuggler
):
    series = set()
    for topic, stream in TOPICS.items():
        for array, joint in stream.layout.places:
            trajectory = stream.layout.type_name.endswith("JointTrajectory")
            series.add(f"{topic}/points[0]/{array}[0]" if trajectory else f"{topic}/{joint}/{array}")
    curves = list(plotjuggler.iter("curve"))
    named = [
        curve.get(key) for curve in curves for key in (("curve_x", "curve_y") if curve.get("curve_x") else ("name",))
    ]
    assert len(named) > 20
    assert set(named) <= series
    text, names = " ".join(message_paths(foxglove)), " ".join(filter(None, (curve.get("name") for curve in curves)))
    assert all(f"{topic}." in text and f"{topic}/" in names for topic in TOPICS)


def test_plotjuggler_plots_have_a_range_and_what_belongs_to_their_mode(plotjuggler):
    for splitter in plotjuggler.iter("DockSplitter"):
        assert int(splitter.get("count")) == len(splitter) == len(splitter.get("sizes").split(";"))
    for plot in plotjuggler.iter("plot"):
        limits = plot.find("range")
        assert float(limits.get("left")) < float(limits.get("right"))
        assert float(limits.get("bottom")) < float(limits.get("top"))
        assert plot.get("mode") in ("TimeSeries", "XYPlot")
        assert all((plot.get("mode") == "XYPlot") == ("curve_x" in curve.attrib) for curve in plot.iter("curve"))
