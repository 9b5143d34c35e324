"""Makes a process with ROS 2's libraries loaded fit to be forked.

Two of them start threads when they are loaded. A fork copies the calling thread only, and whatever another one had
locked at that moment stays locked in the copy for good.
"""

from __future__ import annotations

import ctypes
import os
import re
from pathlib import Path

_MAPPINGS = Path("/proc/self/maps")
_TRACING = re.compile(r"\S*/liblttng-ust[-.](?!fork|tracepoint|common|ctl)\S*$")
_SIGNAL_SET_BYTES = 128
"""At least the size of sigset_t."""


def without_blas_threads() -> None:
    """Keep NumPy and SciPy, which must not have been imported yet, from starting threads."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"


def tell_tracing() -> None:
    """From now on LTTng, to which ROS 2's tracepoints belong, is told of each fork, as it requires (LTTng-UST manual,
    liblttng-ust-fork). Call it when rclpy has been imported; without LTTng, nothing is done."""
    library = _tracing_library()
    if library is None:
        return
    prefix = "lttng_ust_" if hasattr(library, "lttng_ust_before_fork") else "ust_"  # since 2.13; up to 2.12
    signals = ctypes.create_string_buffer(_SIGNAL_SET_BYTES)
    os.register_at_fork(
        before=lambda: library[f"{prefix}before_fork"](signals),
        after_in_parent=lambda: library[f"{prefix}after_fork_parent"](signals),
        after_in_child=lambda: library[f"{prefix}after_fork_child"](signals),
    )


def _tracing_library() -> ctypes.CDLL | None:
    if not _MAPPINGS.exists():
        return None
    found = sorted({match[0] for match in map(_TRACING.search, _MAPPINGS.read_text().splitlines()) if match})
    return ctypes.CDLL(found[0]) if found else None
