"""A file is there whole or not at all."""

import os
import stat

import pytest

from straightcomp_ros.parameters.output_files import write_whole


@pytest.mark.parametrize(
    ("content", "found"), [("Straßenbahn\n", "Straßenbahn\n".encode()), (b"\x00\xff", b"\x00\xff")]
)
def test_text_and_bytes_take_the_place_of_what_was_there(tmp_path, content, found):
    file = tmp_path / "file"
    file.write_text("old")
    write_whole(file, content)
    assert file.read_bytes() == found and [one.name for one in tmp_path.iterdir()] == ["file"]


def test_the_file_is_written_where_the_caller_wants_first(tmp_path):
    parts = tmp_path / "parts"
    with pytest.raises(FileNotFoundError):
        write_whole(tmp_path / "file", "new", parts)
    parts.mkdir()
    write_whole(tmp_path / "file", "new", parts)
    assert (tmp_path / "file").read_text() == "new" and not list(parts.iterdir())


def test_a_file_keeps_its_mode_and_the_link_that_leads_to_it(tmp_path):
    (tmp_path / "real").write_text("old")
    (tmp_path / "real").chmod(0o640)
    link = tmp_path / "folder" / "link"
    link.parent.mkdir()
    link.symlink_to("../real")
    write_whole(link, "new")
    assert link.is_symlink() and (tmp_path / "real").read_text() == "new"
    assert stat.S_IMODE((tmp_path / "real").stat().st_mode) == 0o640
    write_whole(link, "ours", private=True)
    assert stat.S_IMODE((tmp_path / "real").stat().st_mode) == 0o600


def test_a_pipe_gets_what_is_written(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_whole(tmp_path / "pipe", "told")
    assert os.read(reader, 10) == b"told" and (tmp_path / "pipe").is_fifo()
    os.close(reader)


def test_a_failure_leaves_the_old_file_and_no_other_and_names_it(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("old")
    monkeypatch.setattr(os, "fsync", lambda descriptor: os.write(-1, b""))
    with pytest.raises(OSError) as caught:
        write_whole(tmp_path / "file", "new")
    assert caught.value.filename == str(tmp_path / "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"] and (tmp_path / "file").read_text() == "old"
