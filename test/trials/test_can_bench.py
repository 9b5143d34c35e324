"""`python -m trials can` as it is typed, in its short form."""

import json

import pytest

from straightcomp_ros.hardware.can.hub import KINDS
from trials.__main__ import run


def test_costs_are_measured_and_each_fault_is_found(capsys):
    assert run(["can", "--frames", "1000"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["pack_us"] > 0 and figures["unpack_us"] > 0
    assert set(figures["faults"]) == set(KINDS) - {"cut"}
    for count in figures["faults"].values():
        assert count["injected"] == count["detected"] > 0
    assert figures["unflagged_wrong"] == 0
    assert all(loop["unsafe"] == 0 and loop["on"] > 0 for loop in figures["closed_loop"].values())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--frames", "10"], "--frames 10"), (["--set", "driver.simulated.truth.guide=nowhere.csv"], "nowhere.csv")],
)
def test_a_refused_option_ends_with_code_2(capsys, arguments, words):
    assert run(["can", *arguments]) == 2
    assert words in capsys.readouterr().err
