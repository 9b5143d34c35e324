"""Files are written whole, what was made in an output folder is replaced, everything else is kept; and what another
user may have made is never taken for ours."""

import os
import shutil
import stat
import tempfile

import pytest

from straightcomp_ros.parameters import share
from straightcomp_ros.parameters.output_files import UNFINISHED, OutputRefused, making, write_whole
from straightcomp_ros.parameters.share import private_folder


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
    write_whole(tmp_path / "pipe", "sent")
    assert os.read(reader, 10) == b"sent" and (tmp_path / "pipe").is_fifo()
    os.close(reader)


def test_a_failure_leaves_the_old_file_and_no_other_and_names_it(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("old")
    monkeypatch.setattr(os, "fsync", lambda descriptor: os.write(-1, b""))
    with pytest.raises(OSError) as caught:
        write_whole(tmp_path / "file", "new")
    assert caught.value.filename == str(tmp_path / "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"] and (tmp_path / "file").read_text() == "old"


def make(folder, text="new", **how):
    with making(folder, ("bag", "run.png"), **how) as place:
        (place / "bag").mkdir(exist_ok=True)
        (place / "bag" / "bag_0.mcap").write_text(text)
        (place / "run.png").write_text(text)


def kept(folder):
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("[!.]*") if path.is_file()}


@pytest.mark.parametrize("anew", [True, False])
def test_what_was_made_is_replaced_unasked(tmp_path, anew):
    make(tmp_path, "old")
    make(tmp_path, anew=anew)
    assert kept(tmp_path) == {"bag/bag_0.mcap": "new", "run.png": "new"}


def added(folder):
    (folder / "bag" / "notes.txt").write_text("mine")


def changed(folder):
    (folder / "run.png").write_text("mine!")


def moved_there(folder):
    shutil.rmtree(folder / "bag")
    shutil.copytree(folder / "recording", folder / "bag")


def copied(folder):
    for path in list(folder.rglob("*.mcap")):
        os.utime(path, (1, 1))


def without_a_mark(folder):
    (folder / ".straightcomp_made.json").unlink()


def with_a_mark_of_nonsense(folder):
    (folder / ".straightcomp_made.json").write_text("[")


@pytest.mark.parametrize("anew", [True, False])
@pytest.mark.parametrize("done", [added, changed, moved_there, copied, without_a_mark, with_a_mark_of_nonsense])
def test_what_was_not_made_here_is_kept_unless_it_is_asked_for(tmp_path, done, anew):
    (tmp_path / "recording").mkdir()
    (tmp_path / "recording" / "bag_0.mcap").write_text("years")
    make(tmp_path, "old")
    done(tmp_path)
    before = kept(tmp_path)
    with pytest.raises(OutputRefused, match="--force"):
        make(tmp_path, anew=anew)
    assert kept(tmp_path) == before
    make(tmp_path, force=True, anew=anew)
    assert kept(tmp_path)["bag/bag_0.mcap"] == "new" and kept(tmp_path)["recording/bag_0.mcap"] == "years"


@pytest.mark.parametrize("read", ["bag", "bag/bag_0.mcap", "link", "run.png"])
def test_what_is_read_is_never_replaced(tmp_path, read):
    make(tmp_path, "old")
    (tmp_path / "link").symlink_to("bag")
    with pytest.raises(OutputRefused, match="is read"):
        make(tmp_path, reads=[tmp_path / read], force=True)
    assert kept(tmp_path)["run.png"] == "old"


def test_a_run_that_fails_leaves_the_former_results_and_its_own_beside_them(tmp_path):
    make(tmp_path, "old")
    with pytest.raises(ZeroDivisionError), making(tmp_path, ("bag", "run.png")) as place:
        (place / "run.png").write_text("half")
        raise ZeroDivisionError
    assert kept(tmp_path) == {"bag/bag_0.mcap": "old", "run.png": "old", f"{UNFINISHED}/run.png": "half"}
    make(tmp_path)
    assert kept(tmp_path) == {"bag/bag_0.mcap": "new", "run.png": "new"}


def test_two_runs_do_not_write_to_one_folder(tmp_path):
    with making(tmp_path, ["bag"]), pytest.raises(OutputRefused, match="another"):
        make(tmp_path)


def test_a_folder_of_the_user_is_not_taken_for_that_of_an_unfinished_run(tmp_path):
    (tmp_path / UNFINISHED).mkdir()
    (tmp_path / UNFINISHED / "thesis").write_text("mine")
    with pytest.raises(OutputRefused):
        make(tmp_path)
    assert kept(tmp_path) == {f"{UNFINISHED}/thesis": "mine"}


@pytest.fixture
def places(tmp_path, monkeypatch):
    """The user's cache and the folder in the temporary folder, in this order."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    for name in ("cache", "tmp", "other"):
        (tmp_path / name).mkdir()
    private_folder.cache_clear()
    yield tmp_path / "cache" / "straightcomp_ros", tmp_path / "tmp" / f"straightcomp_ros-{os.getuid()}"
    private_folder.cache_clear()


def writable_for_others(place):
    place.mkdir()
    place.chmod(0o777)


def writable_for_the_group(place):
    place.mkdir()
    place.chmod(0o770)


def link(place):
    place.symlink_to(place.parent.parent / "other")


def file(place):
    place.touch()


@pytest.mark.parametrize("taken", [writable_for_others, writable_for_the_group, link, file])
def test_a_place_that_others_may_have_made_is_passed_over(places, taken):
    first, second = places
    taken(first)
    assert private_folder() == second and stat.S_IMODE(second.stat().st_mode) == 0o700
    private_folder.cache_clear()
    second.rmdir()
    taken(second)
    fresh = private_folder()
    assert fresh not in places and fresh.parent == second.parent and not list(fresh.iterdir())
    assert stat.S_IMODE(fresh.stat().st_mode) == 0o700


def test_a_folder_of_another_user_is_passed_over(places, monkeypatch):
    first, _ = places
    first.mkdir(mode=0o700)
    assert private_folder() == first
    private_folder.cache_clear()
    monkeypatch.setattr(share.os, "getuid", lambda: os.geteuid() + 1)
    assert private_folder() not in places
