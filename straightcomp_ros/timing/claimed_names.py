"""Names that processes of this machine claim for as long as they live: abstract sockets.

All users see each other's claims, and a killed process leaves none behind. A container with a network of its own sees
only its own claims.
"""

import socket
import time
from contextlib import suppress
from pathlib import Path

_SOCKETS = Path("/proc/net/unix")
_WAIT_S = 0.01


def claim(name: str, within: float = 0.0) -> socket.socket | None:
    """Claim ``name`` until the returned socket is closed; None if another process keeps it longer than ``within`` s."""
    mine = socket.socket(socket.AF_UNIX)
    deadline = time.monotonic() + within
    while True:
        with suppress(OSError):
            mine.bind(f"\0{name}")
            return mine
        if time.monotonic() >= deadline:
            mine.close()
            return None
        time.sleep(_WAIT_S)


def claimed(prefix: str) -> list[str]:
    """What follows ``prefix`` in the names that are claimed now and begin with it."""
    with suppress(OSError):
        names = [line.partition("@")[2] for line in _SOCKETS.read_text().splitlines()]
        return [name.removeprefix(prefix) for name in names if name.startswith(prefix)]
    return []
