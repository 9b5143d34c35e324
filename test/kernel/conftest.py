"""Tests of a real kernel's CAN: they run in a guest, a Linux kernel that is an ordinary program (user-mode Linux).

The host's pytest collects the tests, boots the guest once with all that were chosen, and reports what the guest's
pytest found as its own. In the guest this same file only writes the reports down.
"""

import contextlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from straightcomp_ros.model.compiled import cache_directory

HERE = Path(__file__).parent
GUEST = "STRAIGHTCOMP_GUEST"
SHARED_IN_GUEST = "/run/shared"
PROGRAMS = ("linux.uml", "insmod", "ip", "tc", "cansend", "cangen", "candump", "canplayer", "gcc")
REMEDY = "apt-get install user-mode-linux kmod iproute2 can-utils gcc"
LONGEST_S = 900
_PATH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])

in_guest = GUEST in os.environ
_FOUND = pytest.StashKey()


def _ours(items):
    return [item for item in items if HERE in item.path.parents]


def pytest_collection_modifyitems(items):
    missing = [program for program in PROGRAMS if shutil.which(program, path=_PATH) is None]
    if missing and not in_guest:
        reason = f"NOT TESTED: SocketCAN in a real kernel; {', '.join(missing)} missing. Remedy: {REMEDY}"
        for item in _ours(items):
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item):
    config = item.config
    # In a worker of xdist a live test fails by itself.
    if in_guest or not _ours([item]) or item.get_closest_marker("skip") or hasattr(config, "workerinput"):
        return None
    if _FOUND not in config.stash:
        config.stash[_FOUND] = _booted(item)
    reports, output = config.stash[_FOUND]
    config.hook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    own = [data for data in reports if data["nodeid"] == item.nodeid]
    for data in own:
        report = config.hook.pytest_report_from_serializable(config=config, data={**data, "$report_type": "TestReport"})
        config.hook.pytest_runtest_logreport(report=report)
    if not own:
        lost = f"the guest ended without a report of this test; it said:\n{output}"
        report = pytest.TestReport(item.nodeid, item.location, {}, "failed", lost, "call")
        config.hook.pytest_runtest_logreport(report=report)
    config.hook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_runtest_logreport(report):
    if in_guest:
        with Path(SHARED_IN_GUEST, "reports").open("a") as file:
            file.write(json.dumps(report._to_json()) + "\n")


def _booted(item):
    """Reports of all tests of this run, as the guest wrote them, and what it printed."""
    with tempfile.TemporaryDirectory(prefix="straightcomp_kernel_") as name:
        folder = Path(name)
        (folder / "command").write_text(_command(item.config.rootpath, _ours(item.session.items)))
        _boot(folder, item.config.rootpath)
        written = {file.name: file.read_text(errors="replace") for file in folder.iterdir() if file.is_file()}
    reports = [json.loads(line) for line in written.get("reports", "").splitlines()]
    return reports, "\n".join(written.get(name, "") for name in ("console", "output"))


def _command(root, items):
    environment = {
        GUEST: "1",
        "PYTHONPATH": root,
        "PYTHONDONTWRITEBYTECODE": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "XDG_CACHE_HOME": cache_directory().parents[1],
    }
    words = ["env", *(f"{name}={value}" for name, value in environment.items())]
    words += [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *(item.nodeid for item in items)]
    return f"cd {root}\n{shlex.join(words)}"


def _boot(folder, root):
    """Run the guest until it has done the command in ``folder``."""
    kernel = shutil.which("linux.uml", path=_PATH)
    registers = folder / "all_registers.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-O2", "-o", registers, HERE / "all_registers.c"], check=True)
    places = [f"REPOSITORY={root}", f"CACHE={cache_directory()}"]
    options = ["mem=1500M", "rootfstype=hostfs", "root=/dev/root", "ro", "con=null", "con0=fd:0,fd:1", "quiet"]
    with (folder / "console").open("wb") as console:
        guest = subprocess.Popen(
            [kernel, *options, f"init={HERE / 'init.sh'}", f"SHARED={folder}", *places],
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=subprocess.STDOUT,
            env={**os.environ, "LD_PRELOAD": str(registers)},
            start_new_session=True,
        )
        try:
            guest.wait(LONGEST_S)
        except subprocess.TimeoutExpired:
            console.write(f"\nstopped after {LONGEST_S} s".encode())
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(guest.pid, signal.SIGKILL)
            guest.wait()
