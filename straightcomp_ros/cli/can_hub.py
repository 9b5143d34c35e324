"""Be a bus between processes of this computer, where the kernel has no CAN: programs that use python-can join it with
interface straightcomp_hub and the socket as the channel. It can spoil frames on purpose; SIGUSR1 cuts all links once.
SIGINT or SIGTERM ends it; it then prints what it has counted."""

from __future__ import annotations

import argparse
import signal
import sys

from straightcomp_ros.cli.output import CommandFailed, check_range, print_json
from straightcomp_ros.hardware.can.bus_faults import KINDS, Faults
from straightcomp_ros.hardware.can.hub import Hub
from straightcomp_ros.hardware.interface import HardwareError
from straightcomp_ros.timing.realtime import RealtimeParameters

SUMMARY = "be a bus between processes, with faults if wanted"
_HIGHEST_PRIORITY = 98


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--socket", required=True, metavar="PATH", help="socket file, the channel of interface straightcomp_hub"
    )
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="KIND=RATE",
        help=f"spoil frames at this rate, 0 to 1; may be repeated. KIND: {', '.join(KINDS)}",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the faults (default: %(default)s)")
    parser.add_argument(
        "--priority",
        "--fifo",
        type=int,
        default=0,
        metavar="N",
        help="SCHED_FIFO priority; best that of the nodes (default: normal scheduling)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Serve until a signal."""
    from straightcomp_ros.timing import realtime

    check_range("--priority", options.priority, 0, _HIGHEST_PRIORITY)
    rates = _rates(options.fault)
    try:
        faults = Faults(rates, options.seed) if rates else None
        hub = Hub(options.socket, faults)
    except (ValueError, HardwareError) as error:
        raise CommandFailed(str(error), exit_code=2) from error
    stopping: list[int] = []
    cutting: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stopping.append(number))
    signal.signal(signal.SIGUSR1, lambda number, _: cutting.append(number))

    def stopped() -> bool:
        # Here no frame is under way.
        if cutting:
            cutting.pop()
            hub.cut()
        return bool(stopping)

    for refusal in realtime.apply(RealtimeParameters(priority=options.priority)):
        print(f"hub: {refusal}", file=sys.stderr)
    if not options.json:
        print("ready", flush=True)
    try:
        hub.run(stopped)
    finally:
        hub.close()
    counters = {"passed": hub.passed, "dropped": hub.dropped, "cuts": hub.cuts}
    injected = faults.injected if faults else {}
    if options.json:
        print_json({**counters, "injected": injected})
    else:
        print(", ".join(f"{name} {count}" for name, count in {**counters, **injected}.items()))
    return 0


def _rates(texts: list[str]) -> dict[str, float]:
    rates = {}
    for text in texts:
        kind, _, rate = text.partition("=")
        try:
            rates[kind] = float(rate)
        except ValueError as error:
            raise CommandFailed(f"--fault {text!r}: allowed: KIND=RATE, e.g. drop=0.01", exit_code=2) from error
    return rates
