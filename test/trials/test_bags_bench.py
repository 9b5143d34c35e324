"""The bench of the bags measures what it says; live parts are left out here."""

import json

import pytest

from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import COMMAND
from trials import bags
from trials.__main__ import run as run_rig
from trials.rig import simulated
from trials.traffic import TRAFFIC, lost


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    values = {
        "controller": {"control.law": "smc"},
        "stage": {"motion.stroke": 0.03, "motion.settle": 0.05, "motion.pause": 0.05},
    }
    return simulated(tmp_path_factory.mktemp("bags") / "run", values)


def test_without_ros_all_but_the_live_figures_are_measured(bag, monkeypatch, capsys):
    monkeypatch.setattr(bags, "ros_available", lambda: False)
    assert run_rig(["bags", "--bag", str(bag)]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["kill"] == {"runs": 0, "max_lost_s": None}
    assert figures["record"]["lost"] is None and figures["record"]["cpu_cores"] is None
    assert figures["read"]["equal"] is True
    read = figures["read"]
    assert read["rosbags_ratio"] == pytest.approx(read["rosbags_us"] / read["ours_us"]) and read["ours_us"] > 0
    assert figures["evaluate_s"] > 0


def test_one_other_bit_is_not_equal(bag):
    stream = read_streams(bag, {COMMAND.topic: COMMAND.layout})[COMMAND.topic]
    rows = [(stamp, [value]) for stamp, value in zip(stream.stamp.tolist(), *stream.columns.values(), strict=True)]
    assert bags._same(stream, rows)
    rows[7] = (rows[7][0], [rows[7][1][0] + 1e-15])
    assert not bags._same(stream, rows)


def test_a_bad_bag_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bags, "ros_available", lambda: False)
    (tmp_path / "bad.mcap").write_bytes(b"nothing")
    assert run_rig(["bags", "--bag", str(tmp_path / "bad.mcap"), "--kill-runs", "0"]) == 2
    assert "is not an MCAP file" in capsys.readouterr().err


def test_what_was_published_and_is_not_in_the_bag_is_lost_be_it_a_whole_topic_or_the_end_of_one(tmp_path):
    encoder, *others, missing = TRAFFIC
    with BagWriter(tmp_path / "bag") as bag:
        for stream in TRAFFIC:
            bag.add_topic(f"/{stream.topic}", stream.layout.type_name)
        stamps = dict.fromkeys((stream.topic for stream in others), range(10)) | {
            encoder.topic: [0, 1, 4, 4, 4, 5, 6, 7],
            missing.topic: [],
        }
        for stream in TRAFFIC:
            for stamp in stamps[stream.topic]:
                message = stream.layout.pack(stamp, *[0.0] * len(stream.layout.columns))
                bag.write(f"/{stream.topic}", message, stamp, stamp)
    assert lost(tmp_path / "bag", 10) == 4 + 10
