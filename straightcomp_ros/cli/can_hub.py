"""Be a bus between processes of this computer, where the kernel has no CAN: programs that use python-can join it with
interface straightcomp_hub and the socket as the channel. It can spoil frames on purpose; SIGUSR1 cuts all links once.
SIGINT or SIGTERM ends it; it then prints its counters."""

import argparse
import signal
import sys
from contextlib import closing

from straightcomp_ros.cli.options import add_repeatable, check_range
from straightcomp_ros.cli.output import CommandFailed, print_json
from straightcomp_ros.hardware.can.hub import KINDS, Faults, Hub
from straightcomp_ros.timing import realtime

SUMMARY = "be a bus between processes, with faults if wanted"
_HIGHEST_PRIORITY = 98


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--socket", required=True, metavar="PATH", help="socket file, the channel of interface straightcomp_hub")
    faults = f"spoil frames at this rate, 0 to 1. KIND: {', '.join(KINDS)}"
    add_repeatable(parser, "--fault", "KIND=RATE", faults, type=_rate)
    add("--seed", type=int, default=0, help="seed of the faults (default: %(default)s)")
    priority = "SCHED_FIFO priority; best that of the nodes (default: normal scheduling)"
    add("--priority", "--fifo", type=int, default=0, metavar="N", help=priority)
    add("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    """Serve until a signal."""
    check_range("--priority", options.priority, 0, _HIGHEST_PRIORITY)
    try:
        faults = Faults(dict(options.fault), options.seed) if options.fault else None
    except ValueError as error:
        raise CommandFailed(str(error), exit_code=2) from error
    hub = Hub(options.socket, faults)
    stopping: list[int] = []
    cutting: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stopping.append(number))
    signal.signal(signal.SIGUSR1, lambda number, _: cutting.append(number))

    def stopped() -> bool:
        # The hub calls this between frames, so a cut here spoils none.
        if cutting:
            cutting.pop()
            hub.cut()
        return bool(stopping)

    for refusal in realtime.apply(realtime.RealtimeParameters(priority=options.priority)):
        print(f"hub: {refusal}", file=sys.stderr)
    if not options.json:
        print("ready", flush=True)
    with closing(hub):
        hub.run(stopped)
    counters = {"passed": hub.passed, "dropped": hub.dropped, "cuts": hub.cuts}
    injected = faults.injected if faults else {}
    if options.json:
        print_json({**counters, "injected": injected})
    else:
        print(", ".join(f"{name} {count}" for name, count in {**counters, **injected}.items()))


def _rate(text: str) -> tuple[str, float]:
    kind, _, rate = text.partition("=")
    try:
        return kind, float(rate)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r}; allowed: KIND=RATE, e.g. drop=0.01") from error
