"""A file is there whole or not at all."""

import pytest

from straightcomp_ros.settings.whole_file import write_whole


@pytest.mark.parametrize(
    ("content", "found"), [("Straßenbahn\n", "Straßenbahn\n".encode()), (b"\x00\xff", b"\x00\xff")]
)
def test_text_and_bytes_take_the_place_of_what_was_there(tmp_path, content, found):
    file = tmp_path / "file"
    file.write_text("old")
    write_whole(file, content)
    assert file.read_bytes() == found and [one.name for one in tmp_path.iterdir()] == ["file"]


def test_the_file_is_written_where_the_caller_wants_first(tmp_path):
    part = tmp_path / "parts" / "1"
    with pytest.raises(FileNotFoundError):
        write_whole(tmp_path / "file", "new", part)
    part.parent.mkdir()
    write_whole(tmp_path / "file", "new", part)
    assert (tmp_path / "file").read_text() == "new" and not part.exists()
