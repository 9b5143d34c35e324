"""What another user may have made is never taken for ours: machine code in it would run."""

import os
import stat
import tempfile

import pytest

from straightcomp_ros.parameters import share
from straightcomp_ros.parameters.share import private_folder


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
