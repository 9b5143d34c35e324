"""The firmware core, compiled for the tests that run it."""

import contextlib
import fcntl
import shutil
import subprocess
from pathlib import Path

import pytest
from places import REPOSITORY

from straightcomp_ros.hardware.can.frames_in_c import frames_in_c

FIRMWARE = REPOSITORY / "firmware"
BUILD = FIRMWARE / "build"


@pytest.fixture(scope="session")
def firmware():
    """Folder with the programs that firmware/Makefile builds."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or shutil.which("make") is None:
        pytest.skip("NOT TESTED: the firmware core; a C compiler or make is missing. Remedy: apt-get install gcc make")
    with _alone():
        _make(compiler)
    return BUILD


@pytest.fixture(scope="session")
def firmware_of(firmware):
    """``firmware_of(can, program)`` is that program for the frames of the board with these parameters."""

    def built(can, program):
        if not can.dbc:
            return firmware / program
        folder = BUILD / Path(can.dbc).stem
        with _alone():
            folder.mkdir(exist_ok=True)
            for name, text in frames_in_c([can.make_wire()]).items():
                if not (folder / name).exists() or (folder / name).read_text() != text:
                    (folder / name).write_text(text)
            target = folder / "build" / program
            _make(shutil.which("cc") or "gcc", str(target), f"GENERATED={folder}", f"BUILD={target.parent}")
        return target

    return built


@contextlib.contextmanager
def _alone():
    """The tests of other processes use the same programs."""
    BUILD.mkdir(exist_ok=True)
    with (BUILD / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _make(compiler, *variables):
    command = ["make", "-s", "-C", str(FIRMWARE), f"CC={compiler}", *variables]
    made = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert made.returncode == 0, made.stdout + made.stderr
