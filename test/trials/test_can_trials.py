"""A bad bus: its faults are found; with the emulated board and with the firmware core the closed loop runs on or stands
in the latched safe state, and never takes a wrong sample."""

import json
from dataclasses import replace

import pytest
from can_boards import FOREIGN, FOREIGN_FILE, SPLIT
from surveys import GUIDE

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.hub import KINDS
from straightcomp_ros.hardware.interface import State
from trials.__main__ import run
from trials.can import ServoTrial

BOARDS = {"classic": CanParameters(fd=False), "fd": CanParameters(fd=True), "foreign": FOREIGN, "split": SPLIT}


@pytest.fixture(params=[(name, program) for name in BOARDS for program in ("emulator", "board_posix")], ids="-".join)
def board(request):
    """Of each kind, as the emulator and as the firmware."""
    name, program = request.param
    if program == "emulator":
        return BOARDS[name]
    return replace(BOARDS[name], firmware=str(request.getfixturevalue("firmware_of")(BOARDS[name], program)))


def test_single_faults_are_bridged_and_the_servo_stays_on(board):
    rates = {kind: 0.002 for kind in KINDS if kind != "cut"}
    trial = ServoTrial(rates, GUIDE, board, frames=3000, seed=3)
    assert sum(trial.injected.values()) > 50
    assert trial.state is State.ON and trial.latched == {} and trial.on > 0.9
    assert trial.unflagged_wrong == trial.unsafe == 0


def test_each_cut_latches_a_fault_and_the_servo_comes_back_after_the_reset(board):
    trial = ServoTrial({"cut": 0.001}, GUIDE, board, frames=4000, seed=2)
    assert trial.injected["cut"] >= 2
    assert 1 <= sum(trial.latched.values()) <= trial.injected["cut"]
    assert trial.unflagged_wrong == trial.unsafe == 0 and trial.on > 0.3


def test_a_bus_that_spoils_many_frames_is_given_up_by_one_side_or_the_other(board):
    # Of two frames for each sample, half as many have to be spoiled.
    rate = 0.11 if board.dbc == SPLIT.dbc else 0.22
    trial = ServoTrial({"corrupt": rate}, GUIDE, board, frames=6000, seed=1)
    words = {"too many frames failed their checks", "the board reports: command check"}
    assert words & set(trial.latched) and trial.on < 0.8
    assert trial.unflagged_wrong == trial.unsafe == 0


def test_the_rig_injects_into_the_frames_of_the_stages_own_board(capsys):
    assert run(["can", "--stage", str(FOREIGN_FILE), "--frames", "1000"]) == 0
    assert list(json.loads(capsys.readouterr().out)["closed_loop"]) == [FOREIGN_FILE.stem]
