"""Files are written whole, what was made in an output folder is replaced, everything else is kept; and what another
user may have made is never taken for ours."""

import errno
import fcntl
import os
import shutil
import stat
import tempfile
from pathlib import Path
from unittest.mock import Mock

import pytest

from straightcomp_ros.parameters import share
from straightcomp_ros.parameters.output_files import (
    MARK,
    UNFINISHED,
    OutputRefused,
    check_writable,
    locked,
    making,
    write_whole,
)
from straightcomp_ros.parameters.share import private_folder


@pytest.mark.parametrize(
    ("content", "written"),
    [
        ("Straßenbahn\n", "Straßenbahn\n".encode()),
        (b"\x00\xff", b"\x00\xff"),
        # A name of a file that is no UTF-8.
        ("# source: M_\udcfc.csv, 1 µm\n", "# source: M_\\udcfc.csv, 1 µm\n".encode()),
    ],
)
def test_text_and_bytes_replace_what_was_there_and_are_written_where_the_caller_wants_first(tmp_path, content, written):
    file, parts = tmp_path / "file", tmp_path / "parts"
    file.write_text("old")
    with pytest.raises(FileNotFoundError):
        write_whole(file, content, parts)
    assert file.read_text() == "old"
    parts.mkdir()
    for folder in (None, parts):
        write_whole(file, content, folder)
        assert file.read_bytes() == written
        assert {one.name for one in tmp_path.iterdir()} == {"file", "parts"} and not list(parts.iterdir())


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


@pytest.mark.skipif(os.getuid() != 0, reason="only root may give a file away")
@pytest.mark.parametrize(("private", "mode"), [(False, 0o640), (True, 0o600)])
def test_what_root_writes_stays_the_owners(tmp_path, private, mode):
    file = tmp_path / "users"
    file.write_text("old")
    file.chmod(0o640)
    os.chown(file, 4711, 4712)
    write_whole(file, "new", private=private)
    found = file.stat()
    assert (found.st_uid, found.st_gid, stat.S_IMODE(found.st_mode)) == (4711, 4712, mode)


def test_a_lock_that_may_not_be_written_is_waited_for_and_taken(tmp_path, monkeypatch):
    # By its name alone: the folders above are root's.
    monkeypatch.chdir(tmp_path)
    tmp_path.chmod(0o755)
    lock, root = Path("lock"), os.geteuid() == 0
    before = os.umask(0o077)
    try:
        with locked(lock):
            assert stat.S_IMODE(lock.stat().st_mode) == 0o644
    finally:
        os.umask(before)
    lock.chmod(0o444)
    if root:
        os.seteuid(4711)
    try:
        with locked(lock), lock.open() as other, pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    finally:
        if root:
            os.seteuid(0)


def test_a_file_system_without_locks_is_an_error_that_names_the_lock(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", Mock(side_effect=OSError(errno.ENOLCK, "No locks available")))
    with pytest.raises(OSError) as caught, locked(tmp_path / "lock"):
        pytest.fail("nothing is locked")
    assert caught.value.filename == str(tmp_path / "lock")


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


def test_what_cannot_be_written_is_known_before_and_nothing_is_left_of_the_attempt(tmp_path):
    (tmp_path / "file").write_text("old")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere" / "file")
    (tmp_path / "loop").symlink_to("loop")
    for name in ("file", "new", "pipe"):
        check_writable(tmp_path / name)
    for name, error in (
        (".", IsADirectoryError),
        ("nowhere/file", FileNotFoundError),
        ("file/new", NotADirectoryError),
        ("link", FileNotFoundError),
        ("loop", OSError),
    ):
        with pytest.raises(error) as caught:
            check_writable(tmp_path / name)
        assert caught.value.filename == str(tmp_path / name) and caught.value.strerror
    assert {one.name for one in tmp_path.iterdir()} == {"file", "pipe", "link", "loop"}
    assert (tmp_path / "file").read_text() == "old"


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


def test_a_file_that_others_go_on_writing_is_replaced_and_one_that_was_there_before_is_not(tmp_path):
    made, own = tmp_path / "made", tmp_path / "own"
    make(made, anew=False)
    (made / "run.png").write_text("written by another")
    make(made, "newer", anew=False, changing=("run.png",))
    assert kept(made)["run.png"] == "newer"
    own.mkdir()
    (own / "run.png").write_text("own")
    with pytest.raises(OutputRefused):
        make(own, anew=False, changing=("run.png",))
    assert kept(own) == {"run.png": "own"}


def moved_there(folder):
    shutil.rmtree(folder / "bag")
    shutil.copytree(folder / "recording", folder / "bag")


CHANGES = {
    "added": lambda folder: (folder / "bag" / "notes.txt").write_text("mine"),
    "changed": lambda folder: (folder / "run.png").write_text("mine!"),
    "moved there": moved_there,
    "copied": lambda folder: [os.utime(path, (1, 1)) for path in folder.rglob("*.mcap")],
    "without a mark": lambda folder: (folder / MARK).unlink(),
    "with a mark of nonsense": lambda folder: (folder / MARK).write_text("["),
}


@pytest.mark.parametrize("anew", [True, False])
@pytest.mark.parametrize("change", CHANGES)
def test_what_was_not_made_here_is_kept_unless_it_is_asked_for(tmp_path, change, anew):
    (tmp_path / "recording").mkdir()
    (tmp_path / "recording" / "bag_0.mcap").write_text("years")
    make(tmp_path, "old")
    CHANGES[change](tmp_path)
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


def test_neither_another_run_nor_the_users_own_folder_is_taken_for_an_unfinished_run(tmp_path):
    with making(tmp_path, ["bag"]), pytest.raises(OutputRefused, match="another"):
        make(tmp_path)
    other = tmp_path / "other"
    (other / UNFINISHED).mkdir(parents=True)
    (other / UNFINISHED / "thesis").write_text("mine")
    with pytest.raises(OutputRefused):
        make(other)
    assert kept(other) == {f"{UNFINISHED}/thesis": "mine"}


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


TAKEN = {
    "writable for others": lambda place: (place.mkdir(), place.chmod(0o777)),
    "writable for the group": lambda place: (place.mkdir(), place.chmod(0o770)),
    "a link": lambda place: place.symlink_to(place.parent.parent / "other"),
    "a file": lambda place: place.touch(),
}


@pytest.mark.parametrize("taken", TAKEN)
def test_a_place_that_others_may_have_made_is_passed_over(places, taken):
    first, second = places
    TAKEN[taken](first)
    assert private_folder() == second and stat.S_IMODE(second.stat().st_mode) == 0o700
    private_folder.cache_clear()
    second.rmdir()
    TAKEN[taken](second)
    fresh = private_folder()
    assert fresh not in places and fresh.parent == second.parent and not list(fresh.iterdir())
    assert stat.S_IMODE(fresh.stat().st_mode) == 0o700


def test_a_user_without_a_home_has_a_folder_in_the_temporary_one(places, monkeypatch):
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("pwd.getpwuid", Mock(side_effect=KeyError))
    for cache in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", cache)
        private_folder.cache_clear()
        assert private_folder() == places[1]


def test_a_folder_of_another_user_is_passed_over(places, monkeypatch):
    first, _ = places
    first.mkdir(mode=0o700)
    assert private_folder() == first
    private_folder.cache_clear()
    monkeypatch.setattr(share.os, "getuid", lambda: os.geteuid() + 1)
    assert private_folder() not in places
