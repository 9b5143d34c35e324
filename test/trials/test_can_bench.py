"""`straightcomp bench can` as it is typed, in its short form."""

import json

import pytest

from straightcomp_ros.cli.law_tables import can_tables
from straightcomp_ros.cli.main import main
from straightcomp_ros.hardware.can.hub import KINDS

SHORT = ["--frames", "1000", "--seconds", "0.5", "--cuts", "1"]
# The board's process at the priority of the nodes would take the computer from the other tests.
NORMAL = ["--set", "driver.realtime.priority=0"]


@pytest.mark.no_cover  # its loops take three times as long under it
def test_costs_round_trip_and_faults_are_measured_and_each_fault_is_found(capsys):
    assert main(["bench", "can", "--json", *SHORT, *NORMAL]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["pack_us"] > 0 and figures["unpack_us"] > 0
    trip = figures["round_trip_us"]
    assert 0 < trip["p50"] <= trip["p99"] <= trip["max"] and trip["samples"] > 10
    assert set(figures["faults"]) == set(KINDS)
    for count in figures["faults"].values():
        assert count["injected"] == count["detected"] > 0
    assert figures["unflagged_wrong"] == 0
    assert all(loop["unsafe"] == 0 and loop["on"] > 0 for loop in figures["closed_loop"].values())
    costs, faults, loops = can_tables(figures)
    assert (costs.row_count, faults.row_count, loops.row_count) == (15, len(KINDS) + 1, 2)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--frames", "10"], "--frames 10; allowed: 1000 to 1e+07"),
        (["--seconds", "nan"], "--seconds nan; allowed: 0.5 to 3600"),
        (["--cuts", "0"], "--cuts 0; allowed: 1 to 1000"),
        (["--set", "driver.simulated.truth.guide=nowhere.csv"], "nowhere.csv"),
    ],
)
def test_a_refused_option_of_bench_can_ends_with_code_2_and_what_is_allowed(capsys, arguments, words):
    assert main(["bench", "can", *NORMAL, *arguments]) == 2
    assert words in capsys.readouterr().err
