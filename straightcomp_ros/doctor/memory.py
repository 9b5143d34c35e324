"""Memory that may be locked."""

from __future__ import annotations

import resource
from pathlib import Path

from straightcomp_ros.doctor.finding import Finding

_MIB = 1 << 20
_LOCKED = 512 * _MIB
"""A node with NumPy, numba and Fast DDS maps some 300 MiB."""
_CAP_IPC_LOCK = 14


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
