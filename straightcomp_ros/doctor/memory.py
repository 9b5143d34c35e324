"""Shared memory for Fast DDS, and memory that may be locked."""

from __future__ import annotations

import os
import resource
from pathlib import Path

from straightcomp_ros.doctor.finding import Finding
from straightcomp_ros.shared_memory import find_stale

_MIB = 1 << 20
_NEEDED, _COMFORTABLE = 32 * _MIB, 256 * _MIB
"""Four nodes and a player take some 10 MiB; what killed ones left comes on top."""
_LOCKED = 512 * _MIB
"""A node with NumPy, numba and Fast DDS maps some 300 MiB."""
_CAP_IPC_LOCK = 14


def shared_memory(folder: Path = Path("/dev/shm")) -> Finding:
    """Whether nodes on this machine can talk through shared memory, and whether there is room."""
    name = "shared memory"
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        return Finding(
            name, "fail", f"{folder} cannot be written", f"Mount a tmpfs on {folder}; in a container use --ipc=host."
        )
    space = os.statvfs(folder)
    free = space.f_bavail * space.f_frsize
    detail = f"{free / _MIB:.0f} MiB free in {folder}"
    remedy = f"Make it larger (mount -o remount,size=1G {folder}; in a container --shm-size=1g), or remove old files."
    if free < _NEEDED:
        return Finding(name, "fail", detail, remedy)
    return Finding(name, "ok", detail) if free >= _COMFORTABLE else Finding(name, "warn", detail, remedy)


def stale_files(folder: Path = Path("/dev/shm")) -> Finding:
    """Whether killed processes have left files of Fast DDS."""
    stale = find_stale(folder) if folder.is_dir() else []
    if not stale:
        return Finding("stale Fast DDS files", "ok", "none")
    return Finding(
        "stale Fast DDS files",
        "warn",
        f"{len(stale)} in {folder}, e.g. {stale[0]}",
        "Start any node of this package, which removes them, or run fastdds shm clean.",
    )


def locked_memory(limit: int | None = None, status: Path = Path("/proc/self/status")) -> Finding:
    """Whether a node may lock its memory (realtime.lock_memory)."""
    allowed = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] if limit is None else limit
    if _has_capability(status, _CAP_IPC_LOCK):
        return Finding("memlock", "ok", "any amount (CAP_IPC_LOCK)")
    if allowed == resource.RLIM_INFINITY or allowed >= _LOCKED:
        words = "unlimited" if allowed == resource.RLIM_INFINITY else f"{allowed / _MIB:.0f} MiB"
        return Finding("memlock", "ok", words)
    return Finding(
        "memlock",
        "warn",
        f"{allowed / _MIB:.1f} MiB",
        "Give this user 'memlock unlimited' in /etc/security/limits.d/realtime.conf and log in again.",
    )


def _has_capability(status: Path, number: int) -> bool:
    for line in status.read_text().splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> number & 1)
    return False
