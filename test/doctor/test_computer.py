"""Each check of `straightcomp doctor` on made computers: what it calls ok, warn and fail, and what it advises."""

import gzip
import os
import resource
import sys
from types import SimpleNamespace

import pytest

from straightcomp_ros.doctor import Finding, computer

MIB = 1 << 20
FILE, FOLDER = "file", "."
FAST = {"cpu0__cpufreq__scaling_governor": "performance\n"}
MIXED = {**FAST, "cpu1__cpufreq__scaling_governor": "powersave\n"}
DOWN = {"can0__type": "280\n", "can0__operstate": "down\n"}
IDLE = {"stat": "cpu 1 2 3 4 5 6 7 8 0 0\ncpu0 1\n", "loadavg": "0.90 0.50 0.20 1/300 4711\n"}
UNLIMITED = {"sched_rt_runtime_us": "-1\n", "sched_rt_period_us": "1000000\n"}
BUILT_NONE = {"proc__config.gz": gzip.compress(b"CONFIG_PREEMPT_NONE=y\nCONFIG_PREEMPT_DYNAMIC=y\n")}
BUILT_FULL = {"boot__config-7.0": "CONFIG_PREEMPT=y\nCONFIG_PREEMPT_DYNAMIC=y\n"}
STATIC = {"boot__config-7.0": "CONFIG_PREEMPT_VOLUNTARY=y\n# CONFIG_PREEMPT_NONE is not set\n"}
FULL, VOLUNTARY = ({"proc__cmdline": f"preempt=none preempt={chosen} quiet"} for chosen in ("full", "voluntary"))
DYNAMIC = "#1 SMP PREEMPT_DYNAMIC Debian 6.12.57-1"
LOCAL = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def test_this_machine_is_examined_to_the_end_and_the_exit_code_follows(verb):
    ended = verb("doctor", "--json")
    answer = ended.json
    names = [check["name"] for check in answer["checks"]]
    assert set(computer.CHECKS) - {"rclpy"} <= set(names)
    assert answer["ok"] + answer["warn"] + answer["fail"] == len(names)
    assert ended.code == (1 if answer["fail"] else 0)
    for check in answer["checks"]:
        assert (check["remedy"] == "") == (check["state"] == "ok"), check
        assert check["remedy"] == "" or check["remedy"].endswith("."), check


def refused():
    raise PermissionError(1, "Operation not permitted")


@pytest.mark.parametrize(("states", "code"), [(["ok", "warn"], 0), (["fail", "ok"], 1)])
def test_only_a_failure_makes_the_exit_code_other_than_zero(monkeypatch, verb, states, code):
    found = [Finding("a", state, "seen", "Do it.") for state in states]
    monkeypatch.setattr("straightcomp_ros.cli.doctor.examine", lambda: iter(found))
    ended = verb("doctor")
    assert ended.code == code and f"{states[0]}  a: seen" in ended.out and "Do it." in ended.out


def test_a_check_that_the_system_does_not_permit_is_a_warning_and_the_next_one_runs():
    found = list(computer.examine({"a": refused, "b": lambda: Finding("b", "ok", "")}))
    assert [(one.name, one.state) for one in found] == [("a", "warn"), ("b", "ok")]


def answer(rmw):
    """A program that answers as one with this middleware."""
    return f"import json; print(json.dumps(dict(rclpy='here', rmw='{rmw}')))"


@pytest.mark.parametrize(
    ("program", "states", "word"),
    [
        (answer("rmw_fastrtps_cpp"), ["ok", "ok", "ok"], "here"),
        (answer("rmw_cyclonedds_cpp"), ["ok", "ok", "ok"], "here"),
        (answer("rmw_of_tomorrow"), ["ok", "warn", "ok"], "here"),
        (f"{answer('rmw_fastrtps_cpp')}; raise SystemExit(1)", ["ok", "ok", "fail"], "here"),
        ("import no_such_rclpy", ["fail"], "no_such_rclpy"),
        ("import os; os.abort()", ["fail"], "exit code -6"),
        ("import time; time.sleep(600)", ["fail"], "timed out"),
    ],
)
def test_a_missing_or_broken_rclpy_fails_with_its_last_words(program, states, word):
    found = computer.ros((sys.executable, "-c", program), timeout=0.5 if "sleep" in program else 600.0)
    assert [one.state for one in found] == states and word in found[0].detail


def test_another_middleware_is_named_with_what_differs_and_with_its_remedy_where_it_is_missing(monkeypatch):
    monkeypatch.setenv("CYCLONEDDS_URI", "file:///mine.xml")
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    rmw = computer.ros((sys.executable, "-c", answer("rmw_cyclonedds_cpp")), timeout=600.0)[1]
    assert rmw.detail.startswith("rmw_cyclonedds_cpp, profile: CYCLONEDDS_URI; it does not say when a message arrived")
    (found,) = computer.ros((sys.executable, "-c", "import sys; sys.exit(102)"), timeout=600.0)
    assert found.state == "fail" and "asks for rmw_cyclonedds_cpp" in found.remedy


@pytest.mark.parametrize(
    ("variable", "value", "words"),
    [
        ("ROS_DOMAIN_ID", "7", ""),
        ("ROS_DOMAIN_ID", "233", "domainId is over 232"),
        ("ROS_DOMAIN_ID", "abc", "ROS_DOMAIN_ID is not an integral number"),
        ("ROS_LOG_DIR", "/proc/logs", "Failed to create log directory '/proc/logs'"),
        ("HOME", "/proc/nowhere", "Failed to create log directory '/proc/nowhere/.ros/log'"),
    ],
)
def test_what_keeps_a_node_from_starting_is_found(monkeypatch, tmp_path, variable, value, words):
    pytest.importorskip("rclpy")
    for name, one in {**LOCAL, "HOME": str(tmp_path), "ROS_DOMAIN_ID": "7", variable: value}.items():
        monkeypatch.setenv(name, one)
    found = computer.ros(timeout=600.0)[-1]
    assert found.name == "start of a node" and found.state == ("fail" if words else "ok") and words in found.detail


def test_a_profile_that_is_not_there_is_found_since_fast_dds_starts_with_shared_memory(monkeypatch, tmp_path):
    program = (sys.executable, "-c", answer("rmw_fastrtps_cpp"))
    profile = tmp_path / "mine.xml"
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))
    rmw = computer.ros(program, timeout=600.0)[1]
    assert rmw.state == "fail" and f"no file FASTRTPS_DEFAULT_PROFILES_FILE={profile}" in rmw.detail
    profile.touch()
    rmw = computer.ros(program, timeout=600.0)[1]
    assert rmw.state == "ok" and rmw.detail.endswith("profile: FASTRTPS_DEFAULT_PROFILES_FILE")


def nothing(seconds):
    pass


@pytest.mark.parametrize(("stolen", "state"), [(1, "ok"), (30, "warn")])
def test_a_host_that_gives_the_cpus_to_others_is_found(tmp_path, stolen, state):
    (tmp_path / "loadavg").write_text("0.1 0 0 1/300 4711\n")

    def write(idle, steal):
        (tmp_path / "stat").write_text(f"cpu 100 0 0 {idle} 0 0 0 {steal} 0 0\n")

    write(900, 5)
    assert computer.load(tmp_path, lambda seconds: write(1000, 5 + stolen), 4).state == state


def timer(late):
    """What is found of a timer that is so many seconds late."""
    sleeps = []
    return computer.timer(sleeps.append, lambda: sum(sleeps) + late * len(sleeps))


def given(check, *arguments, **files):
    """A check with its arguments; ``FILE`` and ``FOLDER`` become paths among ``files`` (by name, / written __)."""
    texts = {name.replace("__", "/"): text for name, text in files.items()}
    return texts, lambda at: check(*(at / one if one in (FILE, FOLDER) else one for one in arguments))


@pytest.mark.parametrize(
    ("made", "state", "words"),
    [
        (given(computer.load, FOLDER, nothing, 2, **IDLE), "ok", "load 0.9 on 2 CPUs, steal 0%"),
        (given(computer.load, FOLDER, nothing, 1, **IDLE), "warn", "'starved'"),
        (given(computer.distribution, {"ROS_DISTRO": "humble"}), "warn", "jazzy/setup.bash"),
        (given(computer.distribution, {}), "ok", "none sourced"),
        (given(computer.discovery, LOCAL), "ok", "domain 0"),
        (given(computer.discovery, {}), "warn", "LOCALHOST"),
        (given(computer.discovery, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}), "fail", "LOCALHOST"),
        (given(computer.discovery, {**LOCAL, "ROS_LOCALHOST_ONLY": "1"}), "warn", "unset ROS_LOCALHOST_ONLY"),
        (given(computer.discovery, {**LOCAL, "ROS_DOMAIN_ID": ""}), "ok", "domain 0"),
        (given(computer.discovery, {**LOCAL, "ROS_DOMAIN_ID": "102"}), "warn", "0 to 101"),
        (given(computer.discovery, {**LOCAL, "ROS_DOMAIN_ID": "232"}), "warn", "0 to 101"),
        (given(computer.discovery, {**LOCAL, "ROS_DOMAIN_ID": "233"}), "fail", "0 to 101"),
        (given(computer.discovery, {**LOCAL, "ROS_DOMAIN_ID": "abc"}), "fail", "0 to 101"),
        (given(computer.locked_memory, 8 * MIB, FILE, file="CapEff:\t0\n"), "warn", "memlock unlimited"),
        (given(computer.locked_memory, 8 * MIB, FILE, file="CapEff:\t4000\n"), "ok", "CAP_IPC_LOCK"),
        (given(computer.locked_memory, resource.RLIM_INFINITY, FILE, file="CapEff:\t0\n"), "ok", "unlimited"),
        (given(computer.priority, refused), "warn", "rtprio"),
        (given(computer.priority, lambda: None), "ok", "permitted"),
        (given(computer.throttling, FOLDER, "6.11.0", **UNLIMITED), "warn", "sysctl"),
        # The kernel's server for normal programs takes the limit's place.
        (given(computer.throttling, FOLDER, "6.12.57", **UNLIMITED), "ok", "950000"),
        (given(computer.throttling, FOLDER, "6.11.0", **UNLIMITED | {"sched_rt_runtime_us": "700000"}), "ok", "700000"),
        (given(computer.throttling, FOLDER), "ok", "unknown"),
        (given(computer.kernel, FOLDER, "7.0", DYNAMIC, sys__kernel__realtime="1\n"), "ok", "PREEMPT_RT"),
        (given(computer.kernel, FOLDER, "7.0", "#1 SMP PREEMPT_RT Debian 6.12.57-1"), "ok", "PREEMPT_RT"),
        (given(computer.kernel, FOLDER, "6.0", DYNAMIC, **BUILT_FULL), "warn", "preemption unknown Boot with"),
        (given(computer.kernel, FOLDER, "7.0", DYNAMIC, **BUILT_FULL), "warn", "preemption full On a machine"),
        (given(computer.kernel, FOLDER, "7.0", DYNAMIC, **BUILT_NONE), "warn", "preemption none Boot with"),
        (given(computer.kernel, FOLDER, "7.0", DYNAMIC, **BUILT_FULL, **VOLUNTARY), "warn", "preemption voluntary"),
        (given(computer.kernel, FOLDER, "7.0", DYNAMIC, **BUILT_NONE, **FULL), "warn", "preemption full"),
        # What only a dynamic kernel listens to.
        (given(computer.kernel, FOLDER, "7.0", DYNAMIC, **STATIC, **FULL), "warn", "preemption voluntary"),
        (given(computer.wake_up_latency, FILE), "warn", "cannot be written"),
        (given(computer.wake_up_latency, FILE, file=""), "ok", "can be written"),
        (given(computer.cores, 2, ()), "warn", "4 or more"),
        (given(computer.cores, 4, ()), "ok", "4"),
        (given(computer.cores, 4, {1}), "warn", "kept off CPU 1"),
        (given(computer.governor, FOLDER, **FAST), "ok", "performance"),
        (given(computer.governor, FOLDER, **MIXED), "warn", "cpupower"),
        (given(computer.clock, FILE, 1.8e9, file="tsc\n"), "ok", "tsc"),
        (given(computer.clock, FILE, 1.8e9, file="hpet\n"), "warn", "clocksource=tsc"),
        (given(computer.clock, FILE, 0.0, file="tsc\n"), "fail", "year 1970"),
        (given(timer, 50e-6), "ok", "late by 50 µs"),
        (given(timer, 5e-3), "warn", "late by 5000 µs"),
        (given(computer.can_interfaces, FOLDER, eth0__type="1\n"), "warn", "none in the kernel"),
        (given(computer.can_interfaces, FOLDER, can0__type="280\n", can0__operstate="up\n"), "ok", "can0 up"),
        (given(computer.can_interfaces, FOLDER, **DOWN), "warn", "ip link set can0 up"),
    ],
)
def test_a_check_judges_a_made_computer(tmp_path, made, state, words):
    files, check = made
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    found = check(tmp_path)
    assert found.state == state and words in f"{found.detail} {found.remedy}"


@pytest.mark.parametrize(("size", "state"), [(1 << 36, "ok"), (1 << 32, "warn"), (1 << 20, "fail")])
def test_a_full_disk(monkeypatch, tmp_path, size, state):
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_bavail=size // 4096, f_frsize=4096))
    assert computer.disk(tmp_path).state == state
