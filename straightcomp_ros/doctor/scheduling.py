"""Priority, wake-up and clock: what decides how late a loop runs."""

import gzip
import os
import re
import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np

from straightcomp_ros.doctor.finding import Finding
from straightcomp_ros.timing.exclusive import left_behind

_PRIORITY = 40
"""What docs/realtime.md recommends: above all normal processes, below the kernel's interrupt threads."""
_CORES = 4
_LIMITS = "/etc/security/limits.d/realtime.conf"
_SLOW_CLOCKS = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")
_SLEEP_S, _SLEEPS = 0.5e-3, 200
_LATE_S = 1e-3


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
    if not refused:
        return Finding("real-time priority", "ok", f"SCHED_FIFO {_PRIORITY} is permitted")
    remedy = f"Give this user 'rtprio 98' in {_LIMITS} and log in again; in a container use --cap-add SYS_NICE."
    return Finding("real-time priority", "warn", f"SCHED_FIFO {_PRIORITY}: {refused[0].strerror}", remedy)


def throttling(file: Path = Path("/proc/sys/kernel/sched_rt_runtime_us")) -> Finding:
    """Whether a node that spins at real-time priority leaves time to log in and stop it."""
    runtime = file.read_text().strip() if file.is_file() else "unknown"
    if runtime != "-1":
        return Finding("real-time throttling", "ok", f"{runtime} µs of each period")
    remedy = "Switch it on again: sudo sysctl kernel.sched_rt_runtime_us=950000."
    return Finding("real-time throttling", "warn", "off", remedy)


def wake_up_latency(file: Path = Path("/dev/cpu_dma_latency")) -> Finding:
    """Whether a node may keep the CPUs from deep sleep (realtime.keep_awake)."""
    name = "CPU wake-up"
    if not file.exists():
        return Finding(name, "warn", f"{file} is not there", "Choose a kernel with CPU idle governors, or ignore this.")
    if os.access(file, os.W_OK):
        return Finding(name, "ok", f"{file} can be written")
    remedy = 'Add the udev rule KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660" and join that group.'
    return Finding(name, "warn", f"{file} cannot be written", remedy)


def kernel(file: Path = Path("/sys/kernel/realtime"), release: str | None = None) -> Finding:
    """Whether this is a PREEMPT_RT kernel."""
    name = release or os.uname().release
    if file.is_file() and file.read_text().strip() == "1":
        return Finding("kernel", "ok", f"{name}, PREEMPT_RT")
    remedy = "Install a PREEMPT_RT kernel (Debian: linux-image-rt-amd64) on a machine that is to run for hours."
    return Finding("kernel", "warn", f"{name}, no PREEMPT_RT", remedy)


def preemption(
    folder: Path = Path("/"), release: str | None = None, command_line: Path = Path("/proc/cmdline")
) -> Finding:
    """Whether a real-time thread may interrupt the kernel's own work for other programs.

    ``folder`` holds proc/config.gz or boot/config-RELEASE; ``release`` None is the running kernel's.
    """
    name = "kernel preemption"
    compressed, plain = folder / "proc/config.gz", folder / f"boot/config-{release or os.uname().release}"
    if compressed.is_file():
        text = gzip.decompress(compressed.read_bytes()).decode()
    elif plain.is_file():
        text = plain.read_text()
    else:
        return Finding(name, "warn", "this kernel does not show its configuration", "Boot with preempt=full.")
    options = set(re.findall(r"^CONFIG_PREEMPT_?(\w*)=y$", text, re.MULTILINE))
    if "RT" in options:
        return Finding(name, "ok", "PREEMPT_RT")
    model = next((each.lower() for each in ("LAZY", "VOLUNTARY", "NONE") if each in options), "full")
    if "DYNAMIC" in options:
        chosen = re.findall(r"\bpreempt=(\w+)", command_line.read_text() if command_line.is_file() else "")
        model = chosen[-1] if chosen else model
    if model == "full":
        return Finding(name, "ok", model)
    detail = f"{model}: a program that writes to the disk can keep the loop from its CPU for tens of ms"
    remedy = "Boot with preempt=full." if "DYNAMIC" in options else "Install a kernel with full preemption."
    return Finding(name, "warn", detail, remedy)


def cores(count: int | None = None, lost: Collection[int] | None = None) -> Finding:
    """Whether there is a CPU for each node that must not wait, and for other programs too."""
    usable = len(os.sched_getaffinity(0)) if count is None else count
    lost = left_behind() if lost is None else lost
    if lost:
        cpus = ", ".join(map(str, sorted(lost)))
        detail = f"{usable}; other programs are kept off CPU {cpus} by a driver that was killed with all its processes"
        remedy = "Run straightcomp demo once more as the same user: when it ends, all programs may use all CPUs again."
        return Finding("cores", "warn", detail, remedy)
    if usable >= _CORES:
        return Finding("cores", "ok", f"{usable}")
    remedy = f"Use {_CORES} or more: driver, feedforward and controller want one each."
    return Finding("cores", "warn", f"{usable}", remedy)


def governor(folder: Path = Path("/sys/devices/system/cpu")) -> Finding:
    """Whether the CPUs keep their speed."""
    found = {file.read_text().strip() for file in folder.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    slower = sorted(found - {"performance"})
    if not slower:
        return Finding("frequency governor", "ok", ", ".join(found) or "none: the frequency is not ours to set")
    remedy = "Run sudo cpupower frequency-set --governor performance."
    return Finding("frequency governor", "warn", ", ".join(slower), remedy)


def clock(
    file: Path = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource"), now: float | None = None
) -> Finding:
    """Whether the clock is quick to read, and whether the date is one that bags can be found by."""
    source = file.read_text().strip() if file.is_file() else "unknown"
    year = time.gmtime(time.time() if now is None else now).tm_year
    detail = f"source {source}, resolution {time.get_clock_info('monotonic').resolution * 1e9:g} ns, year {year}"
    if year < 2024:
        return Finding("clock", "fail", detail, "Set the date (sudo timedatectl set-ntp true): stamps of bags need it.")
    if source in _SLOW_CLOCKS:
        return Finding("clock", "warn", detail, "Boot with clocksource=tsc: reading this one takes a microsecond.")
    return Finding("clock", "ok", detail)


def timer(sleep: Callable[[float], None] = time.sleep, clock_now: Callable[[], float] = time.perf_counter) -> Finding:
    """How late a thread of normal priority wakes up now."""
    late = []
    for _ in range(_SLEEPS):
        start = clock_now()
        sleep(_SLEEP_S)
        late.append(clock_now() - start - _SLEEP_S)
    p99, worst = float(np.percentile(late, 99.0)), max(late)
    detail = f"late by {p99 * 1e6:.0f} µs (p99), {worst * 1e6:.0f} µs at most, of {_SLEEPS}"
    if p99 <= _LATE_S:
        return Finding("timer", "ok", detail)
    return Finding("timer", "warn", detail, "End other programs, or set realtime.priority as docs/realtime.md says.")
