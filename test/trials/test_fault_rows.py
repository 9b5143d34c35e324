"""Rows of the trials of faults: what makes one green."""

import pytest

from straightcomp_ros.cell.launcher import ros_available

if not ros_available():
    pytest.skip("rclpy is not there", allow_module_level=True)

from trials.__main__ import run
from trials.faults import Row


def row(**changed):
    values = {"injected": 2, "times_ms": [1.0, 3.0], **changed}
    return Row("sample NaN", 10.0, "amplifier off", "reset", **values)


def test_a_row_is_green_only_if_each_injection_was_found_in_time_with_all_that_must_follow():
    assert row().green
    assert not row(injected=3).green
    assert not row(times_ms=[1.0, 11.0]).green
    assert not row(failures=["the fault was not latched"]).green
    assert not row(injected=0, times_ms=[]).green
    expected = {"name": "sample NaN", "injected": 2, "detected": 2, "median_ms": 2.0, "max_ms": 3.0, "limit_ms": 10.0}
    assert expected.items() <= row().to_display().items()


def test_a_choice_that_names_no_fault_is_refused(capsys):
    assert run(["faults", "--only", "earthquake"]) == 2
    assert "sample NaN" in capsys.readouterr().err
