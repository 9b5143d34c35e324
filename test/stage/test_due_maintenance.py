"""What is due by a file of advice: read again when it changes; a file that does not serve says so."""

import json
import os

import pytest

from straightcomp_ros.stage.due_maintenance import MaintenanceError, due_maintenance, read_advice


def test_what_is_due_is_that_of_the_present_file_and_nothing_where_none_is_there(tmp_path):
    path = tmp_path / "stage.json"
    assert due_maintenance(str(path)) == due_maintenance("") == ""
    path.write_text(json.dumps({"stage": "a", "as_of": "2026-05-01", "advice": [{"text": "worn", "remedy": "mend"}]}))
    assert due_maintenance(str(path)) == "as of 2026-05-01: worn; mend"
    path.write_text(json.dumps({"stage": "a", "as_of": "2026-05-02", "advice": []}))
    assert due_maintenance(str(path)) == ""
    path.write_text("[" * 100_000)
    assert "is no file of advice" in due_maintenance(str(path))
    os.remove(path)
    os.mkfifo(path)
    assert "is a pipe" in due_maintenance(str(path))


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"stage": "a", "as_of": "b", "advice": [1]}', "\xff"])
def test_a_damaged_file_or_a_folder_says_so_in_place_of_advice(tmp_path, content):
    path = tmp_path / "stage.json"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(MaintenanceError, match=r"stage\.json: is no file of advice .*history advise"):
        read_advice(path)
    assert "stage.json" in due_maintenance(str(path))
    assert "cannot be read" in due_maintenance(str(tmp_path))
