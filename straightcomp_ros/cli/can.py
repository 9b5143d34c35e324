"""Tools for the CAN bus.

`hub` is a bus between processes of this computer, where the kernel has no CAN: programs that use python-can join it
with interface straightcomp_hub and the socket as the channel. It can spoil frames on purpose."""

from __future__ import annotations

import argparse
import signal

from straightcomp_ros.cli.output import CommandFailed, print_json
from straightcomp_ros.hardware.can.faults import KINDS, Faults
from straightcomp_ros.hardware.can.hub import Hub
from straightcomp_ros.hardware.interface import HardwareError

SUMMARY = "a CAN bus between processes, with faults if wanted"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    tools = parser.add_subparsers(dest="tool", metavar="TOOL", required=True)
    hub = tools.add_parser("hub", help="be the bus until SIGINT or SIGTERM, then print the counters as JSON")
    hub.add_argument(
        "--socket", required=True, metavar="PATH", help="socket file, the channel of interface straightcomp_hub"
    )
    hub.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="KIND=RATE",
        help=f"spoil frames at this rate, 0 to 1; may be repeated. KIND: {', '.join(KINDS)}",
    )
    hub.add_argument("--seed", type=int, default=0, help="seed of the faults (default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    """Run one tool."""
    rates = _rates(options.fault)
    try:
        faults = Faults(rates, options.seed) if rates else None
        hub = Hub(options.socket, faults)
    except (ValueError, HardwareError) as error:
        raise CommandFailed(str(error), exit_code=2) from error
    stopping: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stopping.append(number))
    print("ready", flush=True)
    try:
        hub.run(lambda: bool(stopping))
    finally:
        hub.close()
    counters = {"passed": hub.passed, "dropped": hub.dropped, "cuts": hub.cuts}
    print_json({**counters, "injected": faults.injected if faults else {}})
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
