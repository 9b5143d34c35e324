"""Tools for the CAN bus."""

import argparse
import dataclasses
import sys
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from shlex import quote
from typing import Any

from straightcomp_ros.cli import Tool
from straightcomp_ros.cli.options import (
    add_force,
    add_json,
    add_parameter_options,
    add_repeatable,
    add_setting_option,
    add_stage_argument,
    chosen_parameters,
    in_range,
    named_files,
    stage_values,
)
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, print_written, working

SUMMARY = "a CAN bus between processes, recorded buses, and frames in C"
PURPOSE = "set up"


def _hub_arguments(parser: argparse.ArgumentParser) -> None:
    from straightcomp_ros.hardware.can.hub import KINDS

    add = parser.add_argument
    add("--socket", required=True, metavar="PATH", help="socket file, the channel of interface straightcomp_hub")
    faults = f"spoil frames at this rate, 0 to 1. KIND: {', '.join(KINDS)}"
    add_repeatable(parser, "--fault", "KIND=RATE", faults, type=_rate)
    add("--seed", type=int, default=0, help="seed of the faults (default: %(default)s)")
    priority = "SCHED_FIFO priority; best that of the nodes (default: normal scheduling; formerly --fifo)"
    add("--priority", "--fifo", type=in_range(int, 0, 98), default=0, metavar="N", help=priority)
    add_json(parser)


def _hub(options: argparse.Namespace) -> None:
    """Be a bus between processes of this computer, where the kernel has no CAN: programs that use python-can join it
    with interface straightcomp_hub and the socket as the channel. It can spoil frames on purpose. SIGINT,
    SIGTERM or SIGHUP ends it; it then prints its counters."""
    from straightcomp_ros.cell.stop_signals import noting_stop
    from straightcomp_ros.hardware.can.hub import Faults, Hub
    from straightcomp_ros.timing import realtime

    try:
        faults = Faults(dict(options.fault), options.seed) if options.fault else None
    except ValueError as error:
        raise CommandFailed(str(error), exit_code=2) from error
    hub = Hub(options.socket, faults)
    stopping = noting_stop()
    for refusal in realtime.apply(realtime.RealtimeParameters(priority=options.priority)):
        print(f"hub: {refusal}", file=sys.stderr)
    if not options.json:
        print("ready", flush=True)
    with closing(hub):
        hub.run(stopping)
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


def _replay_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("log", metavar="LOG", type=Path, help="recorded frames: .log, .blf, .asc, .trc …")
    add_parameter_options(parser)
    add("--speed", type=in_range(float, 0.01, 100.0), default=1.0, help="speed of the play (default: as recorded)")
    add("--channel", metavar="NAME", help="bus in LOG whose frames are sent, if LOG has several")
    add_json(parser)


def _replay(options: argparse.Namespace) -> None:
    """Send the frames of a recorded board again, at their recorded intervals, to a driver that listens.

    LOG is a candump log, a BLF file, or another format of python-can. The bus, the board's DBC file and its node id are
    those of the node `driver` in the parameter file (can.*). The host's frames in LOG are left out. The driver numbers
    and dates the samples as it did then; with --speed other than 1 stage.rate has to be the recorded one times that
    speed."""
    import can

    from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
    from straightcomp_ros.hardware.can.frame_log import RecordedBus, check_times_and_buses, of_the_board, play
    from straightcomp_ros.hardware.can.link import check_interface, opened_bus
    from straightcomp_ros.hardware.interface import HardwareError
    from straightcomp_ros.parameters.node_parameters import node_parameters

    log = f"log '{options.log}'"
    if not options.log.is_file():
        raise CommandFailed(f"{log}: No such file; name a recorded bus", exit_code=2)
    parameters = node_parameters("driver", chosen_parameters(options)).can
    check_interface(parameters)
    recorded, wire = RecordedBus(options.log, options.channel), parameters.make_wire()
    identifiers = [*wire.identifiers, EmulatorFrames(wire).truth_id]
    try:
        if not check_times_and_buses(of_the_board(recorded, identifiers)):
            raise HardwareError(recorded.damage or _without_frames(recorded, parameters))
    except HardwareError as error:
        raise CommandFailed(f"{log}: {error}", exit_code=2) from error
    try:
        with opened_bus(parameters) as bus, working("sending"):
            sent = play(of_the_board(recorded, identifiers), bus, options.speed)
    except (can.CanError, OSError) as error:
        place = f"CAN {parameters.interface} {parameters.channel}"
        raise CommandFailed(f"{place}: {error}; straightcomp doctor says what CAN this machine has") from error
    if recorded.damage:
        notes.print(f"{log}: {recorded.damage}; played up to there")
    if options.json:
        print_json({"sent": sent, "damaged": bool(recorded.damage)})
    else:
        notes.print(f"{sent} frames sent")


def _without_frames(frames: Iterable[Any], parameters: Any) -> str:
    """Why a log has no frame of the board: the package's own has other frames on the other kind of bus."""
    from straightcomp_ros.hardware.can.frame_log import of_the_board

    if not parameters.dbc:
        other = dataclasses.replace(parameters, fd=not parameters.fd).make_wire()
        if seen := sorted({frame.arbitration_id for frame in of_the_board(frames, other.reports)}):
            bus = "CAN FD" if other.fd else "the classic bus"
            names = ", ".join(f"{one:#x}" for one in seen)
            return f"has frames of {bus} ({names}), but can.fd is {str(parameters.fd).lower()}"
    return f"has no frame of board {parameters.node}"


def _firmware_arguments(parser: argparse.ArgumentParser) -> None:
    add_stage_argument(parser)
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="folder for the C files")
    add_setting_option(parser)
    add_force(parser)
    add_json(parser)


def _firmware(options: argparse.Namespace) -> None:
    """Write the frames of a board in C, for the firmware core in firmware/.

    The board's DBC file and the meaning of its signals are those of the stage file (can.dbc, can.wire), for the kind of
    bus that can.fd says; without a DBC file they are the package's own. The core is then built with them by
    `make -C firmware GENERATED=DIR BUILD=DIR/build`."""
    from straightcomp_ros.hardware.can.dbc_file import DbcError
    from straightcomp_ros.hardware.can.frames_in_c import frames_in_c
    from straightcomp_ros.parameters.node_parameters import node_parameters
    from straightcomp_ros.parameters.output_files import making, write_whole

    wire = node_parameters("driver", stage_values(options)).can.make_wire()
    try:
        texts: dict[str, Any] = frames_in_c([wire])
    except DbcError as error:
        raise CommandFailed(f"{wire.dbc.file}: {error}", exit_code=2) from error
    folder: Path = options.output
    try:
        with making(folder, texts, reads=named_files(options, "--output"), force=options.force, anew=False):
            for name, text in texts.items():
                write_whole(folder / name, text)
    except OSError as error:
        raise CommandFailed(f"'{error.filename or folder}': {error.strerror}", exit_code=2) from error
    generated, built = (quote(str(path)) for path in (folder.absolute(), folder.absolute() / "build"))
    build = f"make -C firmware GENERATED={generated} BUILD={built}"
    if options.json:
        print_json({"source": wire.source(), "files": [str(folder / name) for name in texts], "build": build})
        return
    console.print(f"frames of {wire.source()}")
    print_written(*(folder / name for name in texts), then=f"in the source of straightcomp_ros: {build}")


TOOLS = {
    "hub": Tool("be a bus between processes, with faults if wanted", _hub_arguments, _hub),
    "replay": Tool("send a recorded board's frames to a driver", _replay_arguments, _replay),
    "firmware": Tool("write the frames of a board in C, for its firmware", _firmware_arguments, _firmware),
}
