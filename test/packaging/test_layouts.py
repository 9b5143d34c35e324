"""The layouts for Foxglove and PlotJuggler are made from the contract, show every stream, and find numbers in it."""

import json
import re

import numpy as np
from places import BAGS, REPOSITORY
from rosbags.rosbag2 import Reader

from scripts import make_layouts
from straightcomp_ros.bags.topics import typestore
from straightcomp_ros.contract import DISPLACEMENT, STREAMS

CONFIG = REPOSITORY / "config"
LAYOUTS = {f"/{stream.topic}": stream.layout for stream in (*STREAMS, DISPLACEMENT)}


def followed(message, path):
    for name, place in re.findall(r"[./](\w+)(?:\[(\d+)\])?", path):
        message = getattr(message, name)[int(place)] if place else getattr(message, name)
    return message


def test_the_files_are_those_that_the_script_makes_and_show_every_stream(tmp_path):
    make_layouts.make(tmp_path)
    for name in ("foxglove.json", "plotjuggler.xml"):
        assert (tmp_path / name).read_text() == (CONFIG / name).read_text(), "run scripts/make_layouts.py"
    plots = [plot for tab in make_layouts.TABS.values() for plot in tab]
    assert {f"/{stream.topic}" for plot in plots for stream, _ in plot.numbers} == LAYOUTS.keys()


def test_every_path_in_foxglove_is_a_number_of_a_message_and_is_called_as_its_column():
    messages = {}
    for name in ("smc", "survey"):
        with Reader(BAGS / name) as reader:
            for connection in reader.connections:
                _, _, data = next(reader.messages([connection]))
                messages[connection.topic] = typestore().deserialize_cdr(data, connection.msgtype)
    panels = json.loads((CONFIG / "foxglove.json").read_text(encoding="utf-8"))["configById"].values()
    paths = [path for panel in panels for path in (*panel.get("paths", ()), panel.get("xAxisPath")) if path]
    assert len(paths) > 20
    for path in paths:
        topic, rest = re.fullmatch(r"(/\w+)(\..+)", path["value"]).groups()
        assert isinstance(followed(messages[topic], rest), float | np.floating), path
        array, place = re.search(r"\.(\w+)\[(\d+)\]$", rest).groups()
        layout = LAYOUTS[topic]
        columns = [c for c, (a, _) in zip(layout.columns, layout.places, strict=True) if a == array]
        assert path.get("label", columns[int(place)]) == columns[int(place)], path
