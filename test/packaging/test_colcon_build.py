"""Builds the package with colcon in a scratch workspace and starts everything that `ros2 run` would find there."""

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.nightly
NODES = ("driver", "feedforward", "controller", "logger", "cell")
NOT_SOURCES = (".*", "build", "install", "log", "demo_output", "__pycache__", "*.egg-info")
# Generous: Numba compiles in a fresh place, on a machine that others use too.
START_S, STOP_S = 180.0, 60.0

if importlib.util.find_spec("colcon_core") is None:
    pytest.skip(
        "NOT TESTED: whether the package builds with colcon. Remedy: pip install -e '.[test]'", allow_module_level=True
    )


def colcon(workspace: Path, *arguments: str) -> str:
    command = [sys.executable, "-m", "colcon", "--log-base", "log", *arguments]
    done = subprocess.run(command, cwd=workspace, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with a copy of this repository in src/, not built yet."""
    folder = tmp_path_factory.mktemp("workspace")
    shutil.copytree(REPOSITORY, folder / "src" / "straightcomp_ros", ignore=shutil.ignore_patterns(*NOT_SOURCES))
    return folder


@pytest.fixture(scope="module")
def prefix(workspace: Path) -> Path:
    """Where the built package is installed."""
    colcon(workspace, "build", "--event-handlers", "desktop_notification-", "status-")
    return workspace / "install" / "straightcomp_ros"


@pytest.fixture(scope="module")
def environment(prefix: Path) -> dict[str, str]:
    """What a shell has after `source install/setup.bash`."""
    command = ["bash", "-c", f"source '{prefix.parent}/setup.bash' && env -0"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    variables = dict(line.split("=", 1) for line in printed.split("\0") if line)
    apart = {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        # Other tests may run beside these.
        "ROS_DOMAIN_ID": str(os.getpid() % 101 + 1),
        "ROS_LOG_DIR": str(prefix.parent.parent / "log"),
    }
    return {**variables, **apart}


def executable(prefix: Path, name: str) -> str:
    return str(prefix / "lib" / "straightcomp_ros" / name)


def test_colcon_recognises_an_ament_python_package(workspace: Path) -> None:
    # With an invalid package.xml it says "python" here, and builds something that `ros2 run` does not find.
    assert colcon(workspace, "list").split() == ["straightcomp_ros", "src/straightcomp_ros", "(ros.ament_python)"]


@pytest.mark.parametrize(
    "name", [*(f"{node}_node" for node in (*NODES, "player", "opcua", "commissioning")), "straightcomp"]
)
def test_every_executable_is_where_ros2_run_looks(prefix: Path, name: str) -> None:
    assert os.access(executable(prefix, name), os.X_OK)


def test_configuration_launch_files_and_index_marker_are_installed(prefix: Path) -> None:
    share = prefix / "share"
    assert (share / "ament_index" / "resource_index" / "packages" / "straightcomp_ros").is_file()
    assert (share / "straightcomp_ros" / "package.xml").is_file()
    for folder in ("config", "launch"):
        sources = {path.name for path in (REPOSITORY / folder).iterdir() if path.is_file()}
        assert sources <= {path.name for path in (share / "straightcomp_ros" / folder).iterdir()}


def test_the_sourced_workspace_shadows_the_checkout_and_finds_its_own_files(
    prefix: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    program = "import straightcomp_ros.parameters.share as s; print(s.__file__, s.share_path('package.xml'), sep='\\n')"
    module, manifest = subprocess.run(
        [sys.executable, "-c", program], env=environment, cwd=tmp_path, check=True, capture_output=True, text=True
    ).stdout.split()
    assert Path(module).is_relative_to(prefix)
    assert Path(manifest) == prefix / "share" / "straightcomp_ros" / "package.xml"


def test_every_installed_launch_file_describes_its_launch(
    prefix: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    # PyPI has no `launch`: with a stand-in for it, what the files share is found in the sourced workspace, or not.
    program = """
import runpy, sys
from unittest.mock import MagicMock
for name in ("", ".actions", ".event_handlers", ".events", ".launch_description_sources", ".substitutions"):
    sys.modules[f"launch{name}"] = MagicMock()
for name in ("", ".actions", ".parameter_descriptions", ".substitutions"):
    sys.modules[f"launch_ros{name}"] = MagicMock()
for path in sys.argv[1:]:
    runpy.run_path(path)["generate_launch_description"]()
print(sys.modules["straightcomp_ros.runtime.launch_files"].__file__)
"""
    files = sorted((prefix / "share" / "straightcomp_ros" / "launch").glob("*.launch.py"))
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, files)], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0 and files, done.stderr
    assert Path(done.stdout.strip()).is_relative_to(prefix)


def test_the_command_line_prints_its_help(prefix: Path, environment: dict[str, str], tmp_path: Path) -> None:
    done = subprocess.run(
        [executable(prefix, "straightcomp"), "--help"],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=START_S,
    )
    assert done.returncode == 0, done.stderr
    assert "simulate" in done.stdout and "commission" in done.stdout and "history" in done.stdout


@pytest.mark.parametrize("node", NODES)
def test_an_unknown_parameter_ends_the_node_with_exit_code_2_and_its_name(
    node: str, prefix: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    command = [executable(prefix, f"{node}_node"), "--ros-args", "-p", "no_such_parameter:=1"]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=START_S)
    assert done.returncode == 2, done.stdout + done.stderr
    assert "no_such_parameter" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.fixture
def observer(environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """A process beside the node that prints which nodes publish diagnostics, or subscribe to them as the cell does."""
    program = """
import time, rclpy
rclpy.init()
node = rclpy.create_node("observer")
while True:
    ends = node.get_publishers_info_by_topic("/diagnostics") + node.get_subscriptions_info_by_topic("/diagnostics")
    print(*(end.node_name for end in ends), flush=True)
    time.sleep(0.1)
"""
    with subprocess.Popen(
        [sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        yield process
        process.kill()


@pytest.mark.parametrize("node", NODES)
def test_sigint_ends_a_running_node_with_exit_code_0(
    node: str, prefix: Path, environment: dict[str, str], tmp_path: Path, observer: subprocess.Popen[str]
) -> None:
    with subprocess.Popen(
        [executable(prefix, f"{node}_node")],
        env=environment,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            end = time.monotonic() + START_S
            while node not in observer.stdout.readline().split():  # type: ignore[union-attr]
                assert process.poll() is None, process.communicate()[0]
                assert observer.poll() is None, "the observer has ended"
                assert time.monotonic() < end, f"{node} takes no part in /diagnostics {START_S:g} s after its start"
            process.send_signal(signal.SIGINT)
            printed, _ = process.communicate(timeout=STOP_S)
        finally:
            process.kill()
    assert process.returncode == 0, printed
    assert "Traceback" not in printed
