"""Strokes through an emulated board with other frames, and through the firmware core, as a user would compare them."""

import json

import pytest

from straightcomp_ros.cli.main import main

pytestmark = [pytest.mark.live, pytest.mark.keeps_time]


def test_strokes_through_both_kinds_of_frames_and_both_boards_are_compared(firmware, capfd, tmp_path):
    options = ["--firmware", str(firmware.parent), "--output", str(tmp_path), "--set", "stage.motion.stroke=0.06"]
    code = main(["bench", "boards", "--json", *options])
    figures = json.loads(capfd.readouterr().out)
    assert code == (0 if figures["in_order"] else 1)
    assert [(one["frames"], one["board"]) for one in figures["boards"]] == [
        (frames, board) for frames in ("straightcomp.dbc", "board_motorola.dbc") for board in ("emulator", "C core")
    ]
    for one in figures["boards"]:
        assert one["pp_um_of_each"] == [one["pp_um"]] and 0.0 < one["pp_um"] < 100.0
        assert 0.0 < one["latency_p50_us"] <= one["latency_p99_us"]
