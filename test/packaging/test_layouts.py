"""The layouts for Foxglove and PlotJuggler show what there is: every topic and number in them is in the contract."""

import json
import re
from xml.etree import ElementTree

import numpy as np
from places import BAGS, REPOSITORY
from rosbags.rosbag2 import Reader

from scripts import make_layouts
from straightcomp_ros.bags.topics import typestore
from straightcomp_ros.contract import DISPLACEMENT, STREAMS

CONFIG = REPOSITORY / "config"
TOPICS = {f"/{stream.topic}": stream for stream in (*STREAMS, DISPLACEMENT)}
FOXGLOVE = json.loads((CONFIG / "foxglove.json").read_text(encoding="utf-8"))
PLOTJUGGLER = ElementTree.parse(CONFIG / "plotjuggler.xml").getroot()
PLOTS = [panel for name, panel in FOXGLOVE["configById"].items() if name.startswith("Plot!")]
PATHS = [panel["xAxisPath"]["value"] for panel in PLOTS if "xAxisPath" in panel]
PATHS += [path["value"] for panel in PLOTS for path in panel["paths"]]


def followed(message, path):
    for name, place in re.findall(r"[./](\w+)(?:\[(\d+)\])?", path):
        message = getattr(message, name)[int(place)] if place else getattr(message, name)
    return message


def test_the_files_are_those_that_the_script_makes(tmp_path):
    make_layouts.make(tmp_path)
    for name in ("foxglove.json", "plotjuggler.xml"):
        assert (tmp_path / name).read_text() == (CONFIG / name).read_text(), "run scripts/make_layouts.py"


def test_every_path_in_foxglove_is_a_number_of_a_message_and_is_called_as_its_column():
    messages = {}
    for name in ("smc", "survey"):
        with Reader(BAGS / name) as reader:
            for connection in reader.connections:
                _, _, data = next(reader.messages([connection]))
                messages[connection.topic] = typestore().deserialize_cdr(data, connection.msgtype)
    assert len(PATHS) > 20
    for path in PATHS:
        topic, rest = re.fullmatch(r"(/\w+)(\..+)", path).groups()
        assert topic in TOPICS, path
        assert topic not in messages or isinstance(followed(messages[topic], rest), float | np.floating), path
    for path in (one for panel in PLOTS for one in panel["paths"]):
        topic, array, place = re.fullmatch(r"(/\w+)(?:\.points\[0\])?\.(\w+)\[(\d+)\]", path["value"]).groups()
        layout = TOPICS[topic].layout
        columns = [c for c, (a, _) in zip(layout.columns, layout.places, strict=True) if a == array]
        assert columns[int(place)] == path["label"], path


def test_every_curve_in_plotjuggler_is_a_number_of_the_contract_and_every_stream_is_shown_in_both():
    series = set()
    for topic, stream in TOPICS.items():
        trajectory = stream.layout.type_name.endswith("JointTrajectory")
        for array, joint in stream.layout.places:
            series.add(f"{topic}/points[0]/{array}[0]" if trajectory else f"{topic}/{joint}/{array}")
    keys = [("curve_x", "curve_y") if curve.get("curve_x") else ("name",) for curve in PLOTJUGGLER.iter("curve")]
    named = [curve.get(key) for curve, own in zip(PLOTJUGGLER.iter("curve"), keys, strict=True) for key in own]
    assert len(named) > 20 and set(named) <= series
    text, names = " ".join(PATHS), " ".join(filter(None, (curve.get("name") for curve in PLOTJUGGLER.iter("curve"))))
    assert all(f"{topic}." in text and f"{topic}/" in names for topic in TOPICS)
