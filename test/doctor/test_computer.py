"""Each check of `straightcomp doctor` on made machines: what it calls ok, warn and fail, and what it advises."""

import gzip
import json
import os
import resource
import sys
from collections import namedtuple
from pathlib import Path

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.doctor import Finding, computer
from straightcomp_ros.parameters.share import share_path

MIB = 1 << 20


def _file(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def _free(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    space = namedtuple("space", "f_bavail f_frsize")(size // 4096, 4096)
    monkeypatch.setattr(os, "statvfs", lambda _: space)


def test_this_machine_is_examined_to_the_end_and_the_exit_code_follows(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["doctor", "--json"])
    answer = json.loads(capsys.readouterr().out)
    names = [check["name"] for check in answer["checks"]]
    assert set(computer.CHECKS) - {"rclpy"} <= set(names)
    assert answer["ok"] + answer["warn"] + answer["fail"] == len(names)
    assert code == (1 if answer["fail"] else 0)
    for check in answer["checks"]:
        assert (check["remedy"] == "") == (check["state"] == "ok"), check
        assert check["remedy"] == "" or check["remedy"].endswith("."), check


def test_what_the_frames_of_a_stages_board_leave_open_is_reported_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("straightcomp_ros.cli.doctor.examine", lambda: iter(()))
    main(["doctor", "--json", "--stage", str(share_path("config/board_motorola.yaml"))])
    details = [check["detail"] for check in json.loads(capsys.readouterr().out)["checks"]]
    assert any(text.startswith("there is no heartbeat") for text in details)
    assert main(["doctor", "--stage", "nowhere.yaml"]) == 2
    assert "nowhere.yaml" in capsys.readouterr().err


@pytest.mark.parametrize(("states", "code"), [(["ok", "warn"], 0), (["fail", "ok"], 1)])
def test_only_a_failure_makes_the_exit_code_other_than_zero(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], states: list, code: int
) -> None:
    monkeypatch.setattr(
        "straightcomp_ros.cli.doctor.examine", lambda: iter([Finding("a", state, "seen", "Do it.") for state in states])
    )
    assert main(["doctor"]) == code
    printed = capsys.readouterr().out
    assert f"{states[0]}  a: seen" in printed
    assert "Do it." in printed


def test_a_check_that_the_system_does_not_permit_is_a_warning_and_the_next_one_runs() -> None:
    def refused() -> Finding:
        raise PermissionError(13, "Permission denied")

    found = list(computer.examine({"a": refused, "b": lambda: Finding("b", "ok", "")}))
    assert [(one.name, one.state) for one in found] == [("a", "warn"), ("b", "ok")]


def states(check, *cases) -> list[str]:
    return [check(case).state for case in cases]


def test_python_outside_of_the_range_fails() -> None:
    assert states(computer.python, (3, 9), (3, 10), (3, 13), (3, 14)) == ["fail", "ok", "ok", "fail"]


@pytest.mark.parametrize(
    ("program", "states", "word"),
    [
        ('print(\'{"rclpy": "here", "rmw": "rmw_fastrtps_cpp"}\')', ["ok", "ok"], "here"),
        ('print(\'{"rclpy": "here", "rmw": "rmw_cyclonedds_cpp"}\')', ["ok", "ok"], "here"),
        ('print(\'{"rclpy": "here", "rmw": "rmw_of_tomorrow"}\')', ["ok", "warn"], "here"),
        ("import no_such_rclpy", ["fail"], "no_such_rclpy"),
        ("import os; os.abort()", ["fail"], "exit code -6"),
        ("import time; time.sleep(600)", ["fail"], "timed out"),
    ],
)
def test_a_missing_or_broken_rclpy_fails_with_its_last_words(program: str, states: list[str], word: str) -> None:
    found = computer.ros((sys.executable, "-c", program), timeout=0.5 if "sleep" in program else 600.0)
    assert [one.state for one in found] == states
    assert word in found[0].detail


def test_a_middleware_that_is_asked_for_and_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    (found,) = computer.ros((sys.executable, "-c", "import sys; sys.exit(102)"), timeout=600.0)
    assert found.state == "fail" and "asks for rmw_cyclonedds_cpp" in found.remedy


def test_what_differs_under_another_middleware_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", "file:///mine.xml")
    answer = json.dumps({"rclpy": "here", "rmw": "rmw_cyclonedds_cpp"})
    rmw = computer.ros((sys.executable, "-c", f"print('{answer}')"), timeout=600.0)[1]
    assert rmw.detail.startswith("rmw_cyclonedds_cpp, profile: CYCLONEDDS_URI; it does not say when a message arrived")


def test_another_distribution_and_an_open_discovery_are_warned_of() -> None:
    cases = ({"ROS_DISTRO": "humble"}, {}, {"ROS_DISTRO": "jazzy"})
    assert states(computer.distribution, *cases) == ["warn", "ok", "ok"]
    local = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    domains = [{**local, "ROS_DOMAIN_ID": domain} for domain in ("102", "x")]
    assert states(computer.discovery, local, {}, *domains) == ["ok", "warn", "warn", "warn"]


@pytest.mark.parametrize(
    ("limit", "capabilities", "state"),
    [(8 * MIB, "0", "warn"), (8 * MIB, "4000", "ok"), (resource.RLIM_INFINITY, "0", "ok"), (1024 * MIB, "0", "ok")],
)
def test_memory_may_be_locked_by_limit_or_by_capability(
    tmp_path: Path, limit: int, capabilities: str, state: str
) -> None:
    assert computer.locked_memory(limit, _file(tmp_path, "status", f"CapEff:\t{capabilities}\n")).state == state


def test_a_refused_priority_is_a_warning_with_the_way_to_get_it() -> None:
    def refuse() -> None:
        raise PermissionError(1, "Operation not permitted")

    found = computer.priority(refuse)
    assert found.state == "warn"
    assert "rtprio" in found.remedy
    assert computer.priority(lambda: None).state == "ok"


@pytest.mark.parametrize(
    ("configuration", "command_line", "state", "detail"),
    [
        ("CONFIG_PREEMPT_NONE=y\nCONFIG_PREEMPT_DYNAMIC=y\n", "quiet", "warn", "none: "),
        ("CONFIG_PREEMPT_NONE=y\nCONFIG_PREEMPT_DYNAMIC=y\n", "preempt=none preempt=full quiet", "ok", "full"),
        ("CONFIG_PREEMPT=y\nCONFIG_PREEMPT_DYNAMIC=y\n", "preempt=voluntary", "warn", "voluntary: "),
        ("CONFIG_PREEMPT=y\nCONFIG_PREEMPT_DYNAMIC=y\n", "", "ok", "full"),
        ("CONFIG_PREEMPT_VOLUNTARY=y\n", "preempt=full", "warn", "voluntary: "),
        ("CONFIG_PREEMPT_RT=y\n# CONFIG_PREEMPT_NONE is not set\n", "", "ok", "PREEMPT_RT"),
    ],
)
def test_a_kernel_that_finishes_its_own_work_first_is_reported(
    tmp_path: Path, configuration: str, command_line: str, state: str, detail: str
) -> None:
    booted = _file(tmp_path, "cmdline", command_line)
    plain = _file(tmp_path, "boot/config-7.0", configuration)
    assert computer.preemption(tmp_path, "6.0", booted).detail == "this kernel does not show its configuration"
    found = computer.preemption(tmp_path, "7.0", booted)
    assert found.state == state
    assert found.detail.startswith(detail)
    plain.unlink()
    compressed = tmp_path / "proc/config.gz"
    compressed.parent.mkdir()
    compressed.write_bytes(gzip.compress(configuration.encode()))
    assert computer.preemption(tmp_path, "7.0", booted) == found


def test_what_the_kernel_says_of_real_time(tmp_path: Path) -> None:
    assert computer.throttling(_file(tmp_path, "runtime", "-1\n")).state == "warn"
    assert computer.throttling(_file(tmp_path, "runtime", "950000\n")).state == "ok"
    assert computer.kernel(_file(tmp_path, "realtime", "1\n")).state == "ok"
    assert computer.kernel(tmp_path / "missing").state == "warn"
    assert computer.wake_up_latency(tmp_path / "missing").state == "warn"
    assert computer.wake_up_latency(_file(tmp_path, "latency", "")).state == "ok"
    assert [computer.cores(count, ()).state for count in (2, 4)] == ["warn", "ok"]
    lost = computer.cores(4, {1})
    assert lost.state == "warn" and "kept off CPU 1" in lost.detail and "straightcomp demo" in lost.remedy


def test_a_slow_governor_and_a_slow_or_wrong_clock(tmp_path: Path) -> None:
    assert computer.governor(tmp_path).state == "ok"
    _file(tmp_path, "cpu0/cpufreq/scaling_governor", "performance\n")
    assert computer.governor(tmp_path).state == "ok"
    _file(tmp_path, "cpu1/cpufreq/scaling_governor", "powersave\n")
    assert computer.governor(tmp_path).state == "warn"
    assert computer.clock(_file(tmp_path, "source", "tsc\n"), now=1.8e9).state == "ok"
    assert computer.clock(_file(tmp_path, "source", "hpet\n"), now=1.8e9).state == "warn"
    assert computer.clock(tmp_path / "missing", now=0.0).state == "fail"


@pytest.mark.parametrize(("late", "state"), [(50e-6, "ok"), (5e-3, "warn")])
def test_a_late_timer_is_a_warning(late: float, state: str) -> None:
    passed = [0.0]

    def sleep(duration: float) -> None:
        passed[0] += duration + late

    assert computer.timer(sleep, lambda: passed[0]).state == state


def test_can_interfaces_of_the_kernel(tmp_path: Path) -> None:
    _file(tmp_path, "eth0/type", "1\n")
    assert computer.can_interfaces(tmp_path).state == "warn"
    _file(tmp_path, "can0/type", "280\n")
    _file(tmp_path, "can0/operstate", "up\n")
    assert computer.can_interfaces(tmp_path).state == "ok"
    _file(tmp_path, "can0/operstate", "down\n")
    assert "ip link set can0 up" in computer.can_interfaces(tmp_path).remedy


def test_python_can_without_our_interface_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    import can.interfaces

    assert computer.python_can().state == "ok"
    monkeypatch.setattr(can.interfaces, "BACKENDS", {})
    assert computer.python_can().state == "warn"
    monkeypatch.setitem(sys.modules, "can.interfaces", None)
    assert computer.python_can().state == "fail"


@pytest.mark.parametrize(("size", "state"), [(1 << 36, "ok"), (1 << 32, "warn"), (1 << 20, "fail")])
def test_a_full_disk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, size: int, state: str) -> None:
    _free(monkeypatch, size)
    assert computer.disk(tmp_path).state == state
