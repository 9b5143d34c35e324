"""The bench of bags measures what it says."""

import json

import pytest

from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.contract import COMMAND
from trials import bags
from trials.__main__ import run as run_rig
from trials.rig import simulated


def test_reading_is_compared_with_rosbags_to_the_bit_and_what_is_no_bag_is_refused(tmp_path, capsys):
    motion = {"motion.stroke": 0.03, "motion.settle": 0.05, "motion.pause": 0.05}
    bag = simulated(tmp_path / "run", {"controller": {"control.law": "smc"}, "stage": motion})
    assert run_rig(["bags", "--bag", str(bag)]) == 0
    figures = json.loads(capsys.readouterr().out)
    read = figures["read"]
    assert read["equal"] is True and read["ours_us"] > 0 and figures["evaluate_s"] > 0
    assert read["rosbags_ratio"] == pytest.approx(read["rosbags_us"] / read["ours_us"])
    stream = read_streams(bag, {COMMAND.topic: COMMAND.layout})[COMMAND.topic]
    rows = [(stamp, [value]) for stamp, value in zip(stream.stamp.tolist(), *stream.columns.values(), strict=True)]
    assert bags._same(stream, rows)
    rows[7] = (rows[7][0], [rows[7][1][0] + 1e-15])
    assert not bags._same(stream, rows)
    (tmp_path / "bad.mcap").write_bytes(b"nothing")
    assert run_rig(["bags", "--bag", str(tmp_path / "bad.mcap")]) == 2
    assert "is not an MCAP file" in capsys.readouterr().err
