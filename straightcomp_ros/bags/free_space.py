"""Stops a recording before the disk is full."""

from __future__ import annotations

import os
import time
from pathlib import Path

from straightcomp_ros.bags import BagError

_CHECK_EVERY_S = 0.5


class DiskGuard:
    """Looks at the free space now and then.

    Args:
        folder: on the disk that is written to.
        min_free: bytes that must stay free.
    """

    def __init__(self, folder: Path, min_free: int) -> None:
        self._folder, self._min_free = folder, min_free
        self._next = 0.0

    def check(self) -> None:
        """Call it often.

        Raises:
            BagError: less than ``min_free`` is free.
        """
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + _CHECK_EVERY_S
        found = os.statvfs(self._folder)
        free = found.f_bavail * found.f_frsize
        if free < self._min_free:
            raise BagError(
                f"bag {self._folder}: {free} bytes are free on its disk; "
                f"allowed: >= {self._min_free} (min_free_bytes); all that came before is saved"
            )
