"""What `straightcomp bench boards` measures, and what it refuses; its strokes are live tests."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.parameters.share import share_path
from trials.bench.boards import boards, measure
from trials.bench.demo_strokes import BenchFailed

FOREIGN = str(share_path("config/board_motorola.yaml"))


def test_each_board_is_measured_as_emulator_and_as_c_core_built_with_its_own_frames(firmware, tmp_path):
    found = boards([None, FOREIGN], firmware.parent, tmp_path)
    assert [(one.frames, one.kind) for one in found] == [
        ("straightcomp.dbc", "emulator"),
        ("straightcomp.dbc", "C core"),
        ("board_motorola.dbc", "emulator"),
        ("board_motorola.dbc", "C core"),
    ]
    programs = [word.split("=")[1] for one in found for word in one.arguments if "can.firmware" in word]
    contents = [Path(program).read_bytes() for program in programs]
    assert b"board_motorola.dbc" not in contents[0] and b"board_motorola.dbc" in contents[1]
    assert found[2].arguments == ("--stage", FOREIGN)
    assert len(boards([FOREIGN], None, tmp_path)) == 1


def test_a_core_that_cannot_be_built_is_told(tmp_path):
    (tmp_path / "Makefile").write_text("nothing:\n")
    with pytest.raises(BenchFailed, match="No rule to make target"):
        boards([None], tmp_path, tmp_path)


def test_a_board_without_a_finished_stroke_is_told_with_the_reason(capsys):
    assert main(["bench", "boards", "--board", FOREIGN, "--set", "stage.rate=0"]) == 1
    told = capsys.readouterr()
    for name in ("straightcomp.dbc, emulator", "board_motorola.dbc, emulator"):
        assert name in told.out and f"{name}: straightcomp demo: " in told.err
    assert told.err.count("'stage.rate': 0") == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--rounds", "0"], "--rounds 0; allowed: 1 to 1000"),
        (["--firmware", "nowhere"], "--firmware 'nowhere': has no Makefile; allowed: firmware/ of the source"),
        (["--board", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_a_refused_option_ends_with_code_2_and_what_is_allowed(capsys, arguments, words):
    assert main(["bench", "boards", *arguments]) == 2
    assert words in capsys.readouterr().err


def test_a_stroke_that_fails_is_counted_and_the_next_one_is_made(monkeypatch, tmp_path):
    figures = dict.fromkeys(("lost_samples", "lost_commands"), 1) | {"verdict": "starved", "reason": "held up"}
    figures |= dict.fromkeys(("residual_pp_um", "true_pp_um", "latency_p50_us", "latency_p99_us"), 2.0)
    said = iter([("", "the board fell silent\n"), (json.dumps(figures), "")])
    ended = SimpleNamespace(communicate=lambda: next(said))
    monkeypatch.setattr("trials.bench.boards.started", lambda arguments: ended)
    (board,) = boards([None], None, tmp_path)
    found = measure([board], 2, [], tmp_path)
    (one,) = found["boards"]
    assert one["failed"] == ["straightcomp.dbc, emulator: the board fell silent"] and not found["in_order"]
    assert one["pp_um_of_each"] == [2.0] and one["lost_samples"] == 1
    assert one["not_in_order"] == ["straightcomp.dbc, emulator: starved: held up"]
