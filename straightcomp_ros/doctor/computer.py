"""Checks of the computer: software, real-time scheduling, clock, CAN, room for a run.

What a check reads (files, limits, clocks) are its arguments, so that tests can give it other computers.
"""

import gzip
import json
import math
import os
import re
import resource
import subprocess
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from straightcomp_ros.bags.topics import ROS_DISTRO
from straightcomp_ros.cell.launcher import program
from straightcomp_ros.doctor import Finding, State, judged
from straightcomp_ros.parameters.middlewares import MIDDLEWARES, RANGE_VARIABLE, description, missing_profile
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.timing.cpus import left_behind
from straightcomp_ros.timing.realtime import realtime_limit

_LAST_FREE_DOMAIN, _LAST_DOMAIN = 101, 232
"""Ports of domains beyond the first are Linux's ephemeral ports; those beyond the second would be above 65535."""
_ASK_ROS = """
import json, os
import rclpy.utilities
import lifecycle_msgs.srv, sensor_msgs.msg, trajectory_msgs.msg, diagnostic_msgs.msg, std_srvs.srv
answer = {"rclpy": rclpy.__file__, "rmw": rclpy.utilities.get_rmw_implementation_identifier()}
print(json.dumps(answer), flush=True)
from straightcomp_ros.runtime.middleware import own_profile
# Each node has keys of its own under SROS 2, and the doctor has none.
os.environ.pop("ROS_SECURITY_ENABLE", None)
with own_profile():
    rclpy.init()
    rclpy.create_node("straightcomp_doctor", enable_rosout=False, start_parameter_services=False)
rclpy.shutdown()
"""
_MIB, _GIB = 1 << 20, 1 << 30
_LOCKED = 512 * _MIB
"""A node with NumPy, numba and Fast DDS maps some 300 MiB."""
_CAP_IPC_LOCK = 14
_NEEDED, _COMFORTABLE = _GIB, 10 * _GIB
"""A run at 2 kHz writes 0.54 MB/s: 10 GiB are five and a half hours."""
_PRIORITY = 40
"""What docs/realtime.md recommends: above all normal processes, below the kernel's interrupt threads."""
_CORES = 4
_LIMITS = "/etc/security/limits.d/realtime.conf"
_SLOW_CLOCKS = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")
_SLEEP_S, _SLEEPS = 0.5e-3, 200
_LATE_S = 1e-3
_LOOK_S, _BUSY, _STOLEN = 0.5, 0.5, 0.02
"""Time of a look at the CPUs; load for each of them, and share of steal, that leave room for the loop."""
_IDLE, _STEAL = [3, 4], 7
"""Columns of /proc/stat: idle and waiting for the disk; taken by the hypervisor."""
_ARPHRD_CAN = "280"


def package_files() -> Finding:
    """Whether the parameter file and the synthetic survey are found."""
    try:
        folder = share_path("config/straightcomp.yaml").parent
        share_path("config/survey_synthetic.csv")
    except FileNotFoundError as error:
        return Finding("package files", "fail", str(error), "Install the package again: make setup, or colcon build.")
    return Finding("package files", "ok", str(folder))


def ros(command: Sequence[str] = program(_ASK_ROS), timeout: float = 60.0) -> list[Finding]:
    """rclpy, the message packages, the middleware and the start of a node, in a process of their own: a broken one may
    crash it."""
    remedy = f"Source /opt/ros/{ROS_DISTRO}/setup.bash, or install ROS 2's wheels with make setup."
    if "RMW_IMPLEMENTATION" in os.environ:
        remedy += f" RMW_IMPLEMENTATION asks for {os.environ['RMW_IMPLEMENTATION']}: install it, or unset the variable."
    try:
        asked = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return [Finding("rclpy", "fail", f"cannot be asked: {error}", remedy)]
    first, _, more = asked.stdout.partition("\n")
    # Fast DDS ends the process with a sentence on standard output.
    last = (f"{more}{asked.stderr}".strip().splitlines() or [f"ended with exit code {asked.returncode}"])[-1]
    if not first:
        return [Finding("rclpy", "fail", last, remedy)]
    answer = json.loads(first)
    words = description(answer["rmw"], os.environ)
    if missing_profile(answer["rmw"], os.environ):
        rmw = Finding(
            "middleware", "fail", words, "Correct the path, or unset the variable: nodes then use our profile."
        )
    else:
        remedy = "Set RMW_IMPLEMENTATION to rmw_fastrtps_cpp or rmw_cyclonedds_cpp: no other one has been tried."
        rmw = judged("middleware", answer["rmw"] in MIDDLEWARES, words, remedy)
    started = asked.returncode == 0
    remedy = f"Set ROS_DOMAIN_ID to 0 to {_LAST_FREE_DOMAIN}, and ROS_LOG_DIR to a folder that this user may write in."
    node = judged("start of a node", started, "it starts" if started else last, remedy, "fail")
    return [Finding("rclpy", "ok", answer["rclpy"]), rmw, node]


def distribution(environment: Mapping[str, str] = os.environ) -> Finding:
    """Which ROS 2 is sourced, if any."""
    name = environment.get("ROS_DISTRO")
    remedy = f"Source /opt/ros/{ROS_DISTRO}/setup.bash in a new shell."
    detail = name or "none sourced: the wheels of the virtual environment are used"
    return judged("distribution", name in (None, ROS_DISTRO), detail, remedy)


def discovery(environment: Mapping[str, str] = os.environ) -> Finding:
    """Whether nodes find each other and the graph keeps to this machine, and whether its domain's ports are free."""
    localhost_only = environment.get("ROS_LOCALHOST_ONLY") == "1"
    reach = environment.get(RANGE_VARIABLE) or "SUBNET (ROS 2's default)"
    reach = "LOCALHOST (ROS_LOCALHOST_ONLY, which overrides the range)" if localhost_only else reach
    domain = environment.get("ROS_DOMAIN_ID") or "0"
    number = int(domain) if domain.isdecimal() else math.inf
    free, local = f"Set ROS_DOMAIN_ID to 0 to {_LAST_FREE_DOMAIN}", f"Set {RANGE_VARIABLE}=LOCALHOST"
    wrong: Sequence[tuple[bool, State, str]] = (
        (number > _LAST_DOMAIN, "fail", f"{free}: there is no such domain."),
        (number > _LAST_FREE_DOMAIN, "warn", f"{free}: the ports of others are given out by Linux itself."),
        (reach == "OFF", "fail", f"{local}: nodes do not find each other."),
        # Our profile goes by the range.
        (localhost_only, "warn", f"{local} and unset ROS_LOCALHOST_ONLY: with it Fast DDS uses shared memory."),
        (reach != "LOCALHOST", "warn", f"{local} unless other machines shall take part in the graph."),
    )
    state, remedy = next(((state, remedy) for is_so, state, remedy in wrong if is_so), ("ok", ""))
    return Finding("discovery", state, f"discovery range {reach}, domain {domain}", remedy)


def locked_memory(limit: int | None = None, status: Path = Path("/proc/self/status")) -> Finding:
    """Whether a node may lock its memory (realtime.lock_memory)."""
    allowed = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] if limit is None else limit
    capabilities = re.search(r"^CapEff:\s*(\w+)", status.read_text(), re.MULTILINE)
    if capabilities and int(capabilities[1], 16) >> _CAP_IPC_LOCK & 1:
        return Finding("memlock", "ok", "any amount (CAP_IPC_LOCK)")
    if allowed == resource.RLIM_INFINITY:
        return Finding("memlock", "ok", "unlimited")
    remedy = f"Give this user 'memlock unlimited' in {_LIMITS} and log in again."
    return judged("memlock", allowed >= _LOCKED, f"{allowed / _MIB:.1f} MiB", remedy)


def priority(ask: Callable[[], None] | None = None) -> Finding:
    """Whether a thread may have SCHED_FIFO; tried in a thread that ends at once."""
    refused: list[OSError] = []

    def attempt() -> None:
        try:
            (ask or (lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))))()
        except OSError as error:
            refused.append(error)

    thread = threading.Thread(target=attempt)
    thread.start()
    thread.join()
    detail = f"SCHED_FIFO {_PRIORITY}: {refused[0].strerror if refused else 'permitted'}"
    container = "in a container use --ulimit rtprio=98, or as root --cap-add SYS_NICE."
    remedy = f"Give this user 'rtprio 98' in {_LIMITS} and log in again; {container}"
    return judged("real-time priority", not refused, detail, remedy)


def throttling(folder: Path = Path("/proc/sys/kernel"), release: str | None = None) -> Finding:
    """Whether a node that spins at real-time priority leaves time to log in and stop it; ``release`` None is the
    running kernel's."""
    limit, runtime = realtime_limit(folder, release), _read(folder / "sched_rt_runtime_us")
    remedy = "Switch it on again: sudo sysctl kernel.sched_rt_runtime_us=950000."
    detail = f"{limit.replace('/', ' of each ')} µs" if limit else "off" if runtime else "unknown"
    return judged("real-time throttling", bool(limit) or not runtime, detail, remedy)


def wake_up_latency(file: Path = Path("/dev/cpu_dma_latency")) -> Finding:
    """Whether a node may keep the CPUs from deep sleep (realtime.keep_awake)."""
    can = os.access(file, os.W_OK)
    remedy = 'Add the udev rule KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660" and join that group.'
    return judged("CPU wake-up", can, f"{file} {'can' if can else 'cannot'} be written", remedy)


def kernel(folder: Path = Path("/"), release: str | None = None, version: str | None = None) -> Finding:
    """Whether a real-time thread may interrupt the kernel's own work for other programs: under PREEMPT_RT always, else
    by the model of preemption that the kernel was built or booted with.

    ``folder`` holds proc/cmdline, proc/config.gz or boot/config-RELEASE, and sys/kernel/realtime, which only kernels
    with the former patch have; ``release`` and ``version`` None are the running kernel's.
    """
    release = release or os.uname().release
    if _read(folder / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in (version or os.uname().version):
        return Finding("kernel", "ok", f"{release}, PREEMPT_RT")
    compressed, plain = folder / "proc/config.gz", folder / f"boot/config-{release}"
    text = gzip.decompress(compressed.read_bytes()).decode() if compressed.is_file() else _read(plain)
    options = set(re.findall(r"^CONFIG_PREEMPT_?(\w*)=y$", text, re.MULTILINE))
    built = [each.lower() for each in ("NONE", "VOLUNTARY", "LAZY") if each in options]
    booted = re.findall(r"\bpreempt=(\w+)", _read(folder / "proc/cmdline")) if "DYNAMIC" in options else []
    model = ["full" if text else "unknown", *built, *booted][-1]
    remedy = "On a machine that is to run for hours install a PREEMPT_RT kernel (Debian: linux-image-rt-amd64)."
    if model != "full":
        remedy = f"Boot with preempt=full: a program that writes to the disk may hold up the loop. {remedy}"
    return Finding("kernel", "warn", f"{release}, no PREEMPT_RT, preemption {model}", remedy)


def cores(count: int | None = None, lost: Collection[int] | None = None) -> Finding:
    """Whether there is a CPU for each node that must not wait, and for other programs too."""
    usable = len(os.sched_getaffinity(0)) if count is None else count
    lost = left_behind() if lost is None else lost
    if lost:
        cpus = ", ".join(map(str, sorted(lost)))
        detail = f"{usable}; other programs are kept off CPU {cpus} by a driver that was killed with all its processes"
        remedy = "Run straightcomp demo once more as the same user: when it ends, all programs may use all CPUs again."
        return Finding("cores", "warn", detail, remedy)
    remedy = f"Use {_CORES} or more: driver, feedforward and controller want one each."
    return judged("cores", usable >= _CORES, f"{usable}", remedy)


def governor(folder: Path = Path("/sys/devices/system/cpu")) -> Finding:
    """Whether the CPUs keep their speed."""
    found = {_read(file) for file in folder.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    detail = ", ".join(sorted(found)) or "none: the frequency is not ours to set"
    remedy = "Run sudo cpupower frequency-set --governor performance."
    return judged("frequency governor", found <= {"performance"}, detail, remedy)


def clock(
    file: Path = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource"), now: float | None = None
) -> Finding:
    """Whether the clock is quick to read, and whether the date is one that bags can be found by."""
    source = _read(file) or "unknown"
    year = time.gmtime(time.time() if now is None else now).tm_year
    detail = f"source {source}, resolution {time.get_clock_info('monotonic').resolution * 1e9:g} ns, year {year}"
    if year < 2024:
        return Finding("clock", "fail", detail, "Set the date (sudo timedatectl set-ntp true): stamps of bags need it.")
    remedy = "Boot with clocksource=tsc: reading this one takes a microsecond."
    return judged("clock", source not in _SLOW_CLOCKS, detail, remedy)


def load(folder: Path = Path("/proc"), wait: Callable[[float], None] = time.sleep, count: int | None = None) -> Finding:
    """Whether other programs, or other virtual machines (steal), have the CPUs now."""
    usable = len(os.sched_getaffinity(0)) if count is None else count

    def ticks() -> list[int]:
        return [int(number) for number in _read(folder / "stat").split("\n")[0].split()[1:9]]

    before = ticks()
    wait(_LOOK_S)
    spent = np.subtract(ticks(), before)
    idle, steal = (float(spent[place].sum() / max(1, spent.sum())) for place in (_IDLE, _STEAL))
    waiting = float(_read(folder / "loadavg").split()[0])
    detail = f"load {waiting:.1f} on {usable} CPUs, steal {steal:.0%}, idle {idle:.0%}"
    remedy = (
        "End other programs, and give a virtual machine CPUs of its own: on a busy computer a run may end as "
        "'starved', which says nothing of the servo."
    )
    return judged("load", waiting <= _BUSY * usable and steal <= _STOLEN, detail, remedy)


def timer(sleep: Callable[[float], None] = time.sleep, clock_now: Callable[[], float] = time.perf_counter) -> Finding:
    """How late a thread of normal priority wakes up now."""
    late = []
    for _ in range(_SLEEPS):
        start = clock_now()
        sleep(_SLEEP_S)
        late.append(clock_now() - start - _SLEEP_S)
    p99, worst = float(np.percentile(late, 99.0)), max(late)
    detail = f"late by {p99 * 1e6:.0f} µs (p99), {worst * 1e6:.0f} µs at most, of {_SLEEPS}"
    return judged(
        "timer", p99 <= _LATE_S, detail, "End other programs, or set realtime.priority as docs/realtime.md says."
    )


def can_interfaces(folder: Path = Path("/sys/class/net")) -> Finding:
    """The kernel's SocketCAN interfaces and whether they are up."""
    states = {
        device.name: _read(device / "operstate")
        for device in sorted(folder.glob("*"))
        if _read(device / "type") == _ARPHRD_CAN
    }
    if not states:
        remedy = "Plug the adapter in and run ip link; without one, straightcomp can hub is a bus between processes."
        return Finding("CAN interfaces", "warn", "none in the kernel", remedy)
    down = [name for name, state in states.items() if state == "down"]
    remedy = f"Run sudo ip link set {''.join(down[:1])} up type can bitrate 1000000."
    return judged("CAN interfaces", not down, ", ".join(f"{name} {state}" for name, state in states.items()), remedy)


def disk(folder: Path) -> Finding:
    """Free space where bags would be written."""
    if not os.access(folder, os.W_OK):
        return Finding("disk", "fail", f"{folder} cannot be written", "Change to a folder that this user may write in.")
    space = os.statvfs(folder)
    free = space.f_bavail * space.f_frsize
    remedy = "Remove old bags, or record to another disk (the logger's parameter output)."
    detail = f"{free / _GIB:.1f} GiB free in {folder}"
    return judged("disk", free >= _COMFORTABLE, detail, remedy, "fail" if free < _NEEDED else "warn")


def _read(file: Path) -> str:
    """The text of a file of the kernel; empty if there is none."""
    return file.read_text().strip() if file.is_file() else ""


CHECKS: Mapping[str, Callable[[], Finding | list[Finding]]] = {
    "package files": package_files,
    "rclpy": ros,
    "distribution": distribution,
    "discovery": discovery,
    "memlock": locked_memory,
    "real-time priority": priority,
    "real-time throttling": throttling,
    "CPU wake-up": wake_up_latency,
    "kernel": kernel,
    "cores": cores,
    "frequency governor": governor,
    "clock": clock,
    "load": load,
    "timer": timer,
    "CAN interfaces": can_interfaces,
    "disk": lambda: disk(Path.cwd()),
}


def examine(checks: Mapping[str, Callable[[], Finding | list[Finding]]] = CHECKS) -> Iterator[Finding]:
    """Run the checks; one that the system does not permit is a warning, and the others still run."""
    for name, check in checks.items():
        try:
            found = check()
        except (OSError, AttributeError, ValueError) as error:
            found = Finding(name, "warn", f"cannot be looked at: {error}", "Look at it by hand.")
        yield from found if isinstance(found, list) else [found]
