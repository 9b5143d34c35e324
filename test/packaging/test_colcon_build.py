"""Builds the package with colcon in a scratch workspace and runs what `ros2 run` would find there."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from places import REPOSITORY

from straightcomp_ros.cell.launcher import free_domain

pytestmark = pytest.mark.nightly
NODES = ("driver", "feedforward", "controller", "logger", "cell")
NOT_SOURCES = (".*", "build", "install", "log", "demo_output", "__pycache__", "*.egg-info")
# Generous: Numba compiles in a fresh place, on a machine that others use too.
START_S = 180.0

if importlib.util.find_spec("colcon_core") is None:
    pytest.skip(
        "NOT TESTED: whether the package builds with colcon. Remedy: pip install -e '.[nightly]'",
        allow_module_level=True,
    )


def colcon(workspace, *arguments):
    command = [sys.executable, "-m", "colcon", "--log-base", "log", *arguments]
    done = subprocess.run(command, cwd=workspace, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def prefix(tmp_path_factory):
    """Where the package is installed that is built in a workspace with a copy of this repository in src/."""
    workspace = tmp_path_factory.mktemp("workspace")
    shutil.copytree(REPOSITORY, workspace / "src" / "straightcomp_ros", ignore=shutil.ignore_patterns(*NOT_SOURCES))
    # With an invalid package.xml it says "python" here, and builds something that `ros2 run` does not find.
    assert colcon(workspace, "list").split() == ["straightcomp_ros", "src/straightcomp_ros", "(ros.ament_python)"]
    colcon(workspace, "build", "--event-handlers", "desktop_notification-", "status-")
    return workspace / "install" / "straightcomp_ros"


@pytest.fixture(scope="module")
def environment(prefix):
    """What a shell has after `source install/setup.bash`."""
    command = ["bash", "-c", f"source '{prefix.parent}/setup.bash' && env -0"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    variables = dict(line.split("=", 1) for line in printed.split("\0") if line)
    apart = {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        # Other tests may run in parallel with these.
        "ROS_DOMAIN_ID": free_domain(),
        "ROS_LOG_DIR": str(prefix.parent.parent / "log"),
    }
    return {**variables, **apart}


def executable(prefix, name):
    return str(prefix / "lib" / "straightcomp_ros" / name)


def run(command, environment, folder):
    return subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, timeout=START_S)


def test_executables_configuration_launch_files_and_index_marker_are_where_ros2_looks(prefix):
    nodes = (f"{node}_node" for node in (*NODES, "player", "opcua", "commissioning"))
    assert all(os.access(executable(prefix, name), os.X_OK) for name in (*nodes, "straightcomp"))
    share = prefix / "share"
    assert (share / "ament_index" / "resource_index" / "packages" / "straightcomp_ros").is_file()
    assert (share / "straightcomp_ros" / "package.xml").is_file()
    for folder in ("config", "launch"):
        sources = {path.name for path in (REPOSITORY / folder).iterdir() if path.is_file()}
        assert sources <= {path.name for path in (share / "straightcomp_ros" / folder).iterdir()}


def test_the_sourced_workspace_shadows_the_checkout_and_finds_its_own_files(prefix, environment, tmp_path):
    # PyPI has no `launch`: a stand-in for it.
    program = """
import runpy, sys
from unittest.mock import MagicMock
folders = "actions conditions event_handlers events launch_description_sources substitutions".split()
for name in ("launch", *(f"launch.{name}" for name in folders)):
    sys.modules[name] = MagicMock()
for name in ("", ".actions", ".substitutions"):
    sys.modules[f"launch_ros{name}"] = MagicMock()
for path in sys.argv[1:]:
    runpy.run_path(path)["generate_launch_description"]()
import straightcomp_ros.parameters.share as share
print(sys.modules["straightcomp_ros.runtime.launch_files"].__file__, share.__file__, share.share_path("package.xml"))
"""
    files = sorted((prefix / "share" / "straightcomp_ros" / "launch").glob("*.launch.py"))
    done = run([sys.executable, "-c", program, *map(str, files)], environment, tmp_path)
    assert done.returncode == 0 and files, done.stderr
    *modules, manifest = map(Path, done.stdout.split())
    assert all(module.is_relative_to(prefix) for module in modules)
    assert manifest == prefix / "share" / "straightcomp_ros" / "package.xml"


@pytest.mark.parametrize(
    ("words", "code", "printed"),
    [
        ("straightcomp --help", 0, {"simulate", "commission", "history"}),
        ("driver_node --ros-args -p no_such_parameter:=1", 2, {"'no_such_parameter'"}),
    ],
)
def test_an_installed_executable_has_the_verbs_of_all_wings_and_refuses_an_unknown_parameter(
    words, code, printed, prefix, environment, tmp_path
):
    name, *options = words.split()
    done = run([executable(prefix, name), *options], environment, tmp_path)
    assert done.returncode == code and printed <= set((done.stdout + done.stderr).split()), done.stderr
    assert "Traceback" not in done.stderr
