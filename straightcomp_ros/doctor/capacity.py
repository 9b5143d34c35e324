"""Room that a run needs: memory that it may lock, and disk space for its bags."""

import os
import re
import resource
from pathlib import Path

from straightcomp_ros.doctor.finding import Finding

_MIB, _GIB = 1 << 20, 1 << 30
_LOCKED = 512 * _MIB
"""A node with NumPy, numba and Fast DDS maps some 300 MiB."""
_CAP_IPC_LOCK = 14
_NEEDED, _COMFORTABLE = _GIB, 10 * _GIB
"""A run at 2 kHz writes 0.54 MB/s: 10 GiB are five and a half hours."""


def locked_memory(limit: int | None = None, status: Path = Path("/proc/self/status")) -> Finding:
    """Whether a node may lock its memory (realtime.lock_memory)."""
    allowed = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] if limit is None else limit
    capabilities = re.search(r"^CapEff:\s*(\w+)", status.read_text(), re.MULTILINE)
    if capabilities and int(capabilities[1], 16) >> _CAP_IPC_LOCK & 1:
        return Finding("memlock", "ok", "any amount (CAP_IPC_LOCK)")
    if allowed == resource.RLIM_INFINITY:
        return Finding("memlock", "ok", "unlimited")
    if allowed >= _LOCKED:
        return Finding("memlock", "ok", f"{allowed / _MIB:.0f} MiB")
    remedy = "Give this user 'memlock unlimited' in /etc/security/limits.d/realtime.conf and log in again."
    return Finding("memlock", "warn", f"{allowed / _MIB:.1f} MiB", remedy)


def disk(folder: Path) -> Finding:
    """Free space where bags would be written."""
    if not os.access(folder, os.W_OK):
        return Finding("disk", "fail", f"{folder} cannot be written", "Change to a folder that this user may write in.")
    space = os.statvfs(folder)
    free = space.f_bavail * space.f_frsize
    detail = f"{free / _GIB:.1f} GiB free in {folder}"
    if free >= _COMFORTABLE:
        return Finding("disk", "ok", detail)
    remedy = "Remove old bags, or record to another disk (the logger's parameter output)."
    return Finding("disk", "fail" if free < _NEEDED else "warn", detail, remedy)
