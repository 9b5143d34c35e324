"""Which signals ask a program to end in order."""

import signal
from collections.abc import Callable


def terminating() -> tuple[signal.Signals, ...]:
    """SIGTERM, and SIGHUP, which comes when a terminal is closed or its connection breaks, unless this program ignores
    it, as one does that `nohup` started."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return (signal.SIGTERM,) if ignored else (signal.SIGTERM, signal.SIGHUP)


def noting_stop() -> Callable[[], bool]:
    """What says whether this program was asked to end: SIGINT and the others only note that from now on."""
    stopping: list[int] = []
    for number in (signal.SIGINT, *terminating()):
        signal.signal(number, lambda number, _: stopping.append(number))
    return lambda: bool(stopping)
