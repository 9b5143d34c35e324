"""What is due by a file of advice: read again when it changes; a file that does not serve says so."""

import json
import os

import pytest

from straightcomp_ros.stage.due_maintenance import MaintenanceError, WatchedAdvice, read_advice


def test_a_file_is_read_again_when_it_changes_and_not_more_often_than_once_a_second(tmp_path):
    path, now = tmp_path / "stage.json", 0.0
    watched = WatchedAdvice(str(path), lambda: now)
    assert watched.due() == ""
    path.write_text(json.dumps({"stage": "a", "as_of": "2026-05-01", "advice": [{"text": "worn", "remedy": "mend"}]}))
    now = 0.5
    assert watched.due() == ""
    now = 1.0
    assert watched.due() == "as of 2026-05-01: worn; mend"
    path.write_text(json.dumps({"stage": "a", "as_of": "2026-05-02", "advice": []}))
    now = 2.0
    assert watched.due() == ""
    path.write_text("[" * 100_000)
    now = 3.0
    assert "is no file of advice" in watched.due()
    os.remove(path)
    os.mkfifo(path)
    now = 4.0
    assert "is a pipe" in watched.due()
    os.remove(path)
    now = 5.0
    assert watched.due() == WatchedAdvice("", lambda: now).due() == ""


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"stage": "a", "as_of": "b", "advice": [1]}', "\xff"])
def test_a_damaged_file_or_a_folder_says_so_in_place_of_advice(tmp_path, content):
    path = tmp_path / "stage.json"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(MaintenanceError, match=r"stage\.json: is no file of advice .*history advise"):
        read_advice(path)
    assert "stage.json" in WatchedAdvice(str(path)).due()
    assert "cannot be read" in WatchedAdvice(str(tmp_path)).due()
