"""The file of advice, as the live view and the gateway read it."""

import json
import os
from datetime import date

import numpy as np
import pytest

from straightcomp_ros.fleet.maintenance.advice import advice_json, advice_of, write_advice
from straightcomp_ros.stage.due_maintenance import MaintenanceError, WatchedAdvice, read_advice


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def worn_levels(make_levels):
    return make_levels(friction_A=1.0 + 0.005 * np.maximum(np.arange(120) - 60.0, 0.0))


def test_what_is_written_is_read(worn_levels, tmp_path):
    advice = advice_of(worn_levels)
    path = tmp_path / "stage.json"
    write_advice(path, advice_json("gantry", date(2026, 5, 1), advice))
    due = read_advice(path)
    assert (due.stage, due.as_of) == ("gantry", "2026-05-01")
    assert due.text.startswith("as of 2026-05-01: friction rose by") and "regrease" in due.text
    entry = json.loads(path.read_text("utf-8"))["advice"][0]
    assert entry["figures"]["friction_A"]["after"] > entry["figures"]["friction_A"]["before"] > 0.0


def test_advice_that_lapsed_is_not_due(make_levels):
    days = np.arange(120)
    advice = advice_of(make_levels(friction_A=1.0 + 0.3 * ((days >= 60) & (days < 90))))
    assert advice and advice_json("gantry", date(2026, 5, 1), advice)["advice"] == []


def test_a_file_is_read_again_when_it_changes_and_not_more_often_than_once_a_second(tmp_path):
    path, clock = tmp_path / "stage.json", Clock()
    watched = WatchedAdvice(str(path), clock)
    assert watched.due().text == ""
    write_advice(path, {"stage": "a", "as_of": "2026-05-01", "advice": [{"text": "worn", "remedy": "mend"}]})
    clock.now = 0.5
    assert watched.due().text == ""
    clock.now = 1.0
    assert watched.due().text == "as of 2026-05-01: worn; mend"
    write_advice(path, {"stage": "a", "as_of": "2026-05-02", "advice": []})
    clock.now = 2.0
    assert watched.due().text == ""
    os.remove(path)
    clock.now = 3.0
    assert watched.due().text == ""
    assert WatchedAdvice("", clock).due().text == ""


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"stage": "a", "as_of": "b", "advice": [1]}', "\xff"])
def test_a_damaged_file_says_so_in_place_of_advice(tmp_path, content):
    path = tmp_path / "stage.json"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(MaintenanceError, match=r"stage\.json: is no file of advice .*history advise"):
        read_advice(path)
    assert "stage.json" in WatchedAdvice(str(path)).due().text


def test_a_folder_in_place_of_the_file_says_so(tmp_path):
    assert "cannot be read" in WatchedAdvice(str(tmp_path)).due().text
