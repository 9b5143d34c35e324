"""Which signals ask a program to end in order."""

import signal


def terminating() -> tuple[signal.Signals, ...]:
    """SIGTERM, and SIGHUP, which comes when a terminal is closed or its connection breaks, unless this program ignores
    it, as one does that `nohup` started."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return (signal.SIGTERM,) if ignored else (signal.SIGTERM, signal.SIGHUP)
