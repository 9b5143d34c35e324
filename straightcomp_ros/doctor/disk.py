"""Room for bags."""

from __future__ import annotations

import os
from pathlib import Path

from straightcomp_ros.doctor.finding import Finding

_GIB = 1 << 30
_NEEDED, _COMFORTABLE = _GIB, 10 * _GIB
"""A run at 2 kHz writes 0.54 MB/s: 10 GiB are five and a half hours."""


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
