"""Where the launcher finds the executables, and what becomes of the processes it starts."""

import os
import re
import signal
import socket
import subprocess
import sys
from unittest.mock import Mock

import psutil
import pytest
from waiting import comes_true

from straightcomp_ros.cell.launcher import (
    Graph,
    LaunchError,
    executable_command,
    free_domain,
    isolated_environment,
    verb_command,
)


def test_a_sourced_installation_has_the_executables_and_a_missing_one_is_named_with_the_remedy(tmp_path, monkeypatch):
    prefix = tmp_path / "install"
    # Behind a prefix without this package.
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'jazzy'}:{prefix}")
    driver = prefix / "lib/straightcomp_ros/driver_node"
    for path in (driver, prefix / "share/ament_index/resource_index/packages/straightcomp_ros"):
        path.parent.mkdir(parents=True)
        path.touch(0o755)
    assert executable_command("driver_node") == [str(driver)]
    with pytest.raises(LaunchError, match=r"'controller_node' is missing in .*/lib/straightcomp_ros; .*colcon build"):
        executable_command("controller_node")


def test_a_checkout_runs_its_own_modules_and_not_what_lies_in_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    stub = tmp_path / "straightcomp_ros" / "cli" / "main.py"
    stub.parent.mkdir(parents=True)
    for file in (stub, tmp_path / "argparse.py", tmp_path / "straightcomp_ros" / "__init__.py"):
        file.write_text("raise SystemExit('a stub')\n")
    done = subprocess.run(verb_command("--version"), cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith("straightcomp ")
    (python, _, node), verb = executable_command("driver_node"), verb_command("demo")[2]
    assert python == sys.executable and "import driver_node" in node
    assert node.splitlines()[0] == verb.splitlines()[0]


@pytest.mark.parametrize("words", [executable_command("opcua_node"), verb_command("view")])
def test_an_rclpy_of_another_python_ends_nodes_and_verbs_with_what_is_missing_and_the_remedy(words, tmp_path):
    (tmp_path / "rclpy").mkdir()
    (tmp_path / "rclpy" / "__init__.py").write_text("import rclpy._rclpy_pybind11")
    # As setuptools 68 of Ubuntu 24.04 writes the name.
    (tmp_path / "straightcomp_ros-1.dist-info").mkdir()
    (tmp_path / "straightcomp_ros-1.dist-info" / "METADATA").write_text("Name: straightcomp-ros\nVersion: 1\n")
    verbs = "[straightcomp.verbs]\nview = straightcomp_ros.cli.view\n"
    (tmp_path / "straightcomp_ros-1.dist-info" / "entry_points.txt").write_text(verbs)
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(words, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert re.fullmatch(r".*: No module named 'rclpy\._rclpy_pybind11'; source a ROS 2 Jazzy .*\n", done.stderr)


def test_a_program_that_ends_is_reported_with_its_last_line_and_appends_to_its_log_when_started_again(tmp_path):
    with Graph(tmp_path) as graph:
        graph.start_program("short", [sys.executable, "-c", "print('first'); print('last'); raise SystemExit(3)"])
        graph.start_program("cell", ["sleep", "60"], read_output=True)
        graph._processes["short"].wait()
        with pytest.raises(LaunchError, match="node 'short' ended with exit code 3: last"):
            graph.check(["cell", "short"])
        graph.start_program("short", ["sh", "-c", "echo again; kill -KILL $$"]).wait()
        with pytest.raises(LaunchError, match="node 'short' ended with signal SIGKILL: again"):
            graph.check(["short"])
        assert graph.log("short").read_text().split() == ["first", "last", "again"]
        assert graph.exit_code("cell") is None
        assert graph.stop(["cell"]) == {"cell": -2}


def test_a_launcher_in_the_background_of_a_script_interrupts_its_programs_too(tmp_path):
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Graph(tmp_path) as graph:
            graph.start_program("cell", ["sleep", "60"])
            assert graph.stop(["cell"]) == {"cell": -2}
    finally:
        signal.signal(signal.SIGINT, before)


SLOWLY_ENDING = """
import pathlib, signal, sys, time
name, seconds, ended = sys.argv[1:]
def end(*_):
    time.sleep(float(seconds))
    with pathlib.Path(ended).open("a") as file:
        print(name, file=file)
    sys.exit()
signal.signal(signal.SIGINT, end)
print("ready", flush=True)
time.sleep(60)
"""


def test_what_moves_the_machine_ends_before_the_nodes_that_it_needs_for_that(tmp_path):
    ended = tmp_path / "ended"
    with Graph(tmp_path) as graph:
        for name, seconds in (("driver", 0.0), ("opcua", 0.0), ("cell", 0.5)):
            graph.start_program(name, [sys.executable, "-c", SLOWLY_ENDING, name, str(seconds), str(ended)])
            assert comes_true(lambda name=name: "ready" in graph.log(name).read_text(), 60.0)
        assert graph.stop() == {"cell": 0, "opcua": 0, "driver": 0}
        assert ended.read_text().split() == ["opcua", "cell", "driver"]
        assert graph.stop() == {}


def test_children_of_a_killed_launcher_do_not_run_on(tmp_path):
    code = (
        "import pathlib, time\n"
        "from straightcomp_ros.cell.launcher import Graph\n"
        f"graph = Graph(pathlib.Path({str(tmp_path)!r}))\n"
        "print(graph.start_program('node', ['sleep', '60']).pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as launcher:
        child = int(launcher.stdout.readline())
        launcher.kill()
    assert comes_true(lambda: not psutil.pid_exists(child), 10.0)


@pytest.mark.parametrize("participant", [0, 7])
def test_a_domain_in_which_a_participant_listens_is_not_free(participant):
    taken = 101
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("", 7400 + 250 * taken + 10 + 2 * participant))
        with pytest.raises(LaunchError, match="101 is in use"):
            free_domain([taken])
        assert {free_domain([*range(92, 101), taken]) for _ in range(100)} <= set(map(str, range(92, 101)))


def test_a_domain_that_is_set_is_taken_where_none_is_free(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    monkeypatch.setattr(socket.socket, "bind", Mock(side_effect=OSError))
    assert isolated_environment()["ROS_DOMAIN_ID"] == "7"
    with pytest.raises(LaunchError):
        free_domain()
