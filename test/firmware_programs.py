"""The firmware core, compiled for the tests that run it."""

import fcntl
import shutil
import subprocess
from pathlib import Path

import pytest

FIRMWARE = Path(__file__).resolve().parents[1] / "firmware"
BUILD = FIRMWARE / "build"


@pytest.fixture(scope="session")
def firmware():
    """Folder with the programs that firmware/Makefile builds."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or shutil.which("make") is None:
        pytest.skip("NOT TESTED: the firmware core; a C compiler or make is missing. Remedy: apt-get install gcc make")
    BUILD.mkdir(exist_ok=True)
    with (BUILD / "lock").open("w") as lock:
        # The tests of other processes use the same programs.
        fcntl.flock(lock, fcntl.LOCK_EX)
        made = subprocess.run(
            ["make", "-s", "-C", str(FIRMWARE), f"CC={compiler}"], capture_output=True, text=True, timeout=300
        )
    assert made.returncode == 0, made.stdout + made.stderr
    return BUILD
