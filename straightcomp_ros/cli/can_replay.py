"""Send the frames of a recorded board again, at their recorded intervals, to a driver that listens.

LOG is a candump log, a BLF file, or another format of python-can. The bus, the board's DBC file and its node id are
those of the node `driver` in the parameter file (can.*). The host's frames in LOG are left out. The driver numbers and
dates the samples as it did then; with --speed other than 1 stage.rate has to be the recorded one times that speed."""

import argparse
from collections.abc import Iterator
from pathlib import Path

import can

from straightcomp_ros.cli.options import check_range
from straightcomp_ros.cli.output import CommandFailed, notes, print_json, working
from straightcomp_ros.cli.parameter_options import add_parameter_options, chosen_parameters
from straightcomp_ros.configuration.node_parameters import node_parameters
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frame_log import DamagedLog, of_the_board, play, recorded_frames
from straightcomp_ros.hardware.can.link import check_interface, opened_bus

SUMMARY = "send a recorded board's frames to a driver"
_SLOWEST, _FASTEST = 0.01, 100.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="LOG", type=Path, help="recorded frames: .log, .blf, .asc, .trc …")
    add_parameter_options(parser)
    parser.add_argument("--speed", type=float, default=1.0, help="speed of the play (default: as recorded)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    check_range("--speed", options.speed, _SLOWEST, _FASTEST)
    if not options.log.is_file():
        raise CommandFailed(f"log '{options.log}': No such file; name a recorded bus", exit_code=2)
    parameters = node_parameters("driver", chosen_parameters(options)).can
    damage = ""

    def frames() -> Iterator[can.Message]:
        nonlocal damage
        try:
            yield from recorded_frames(options.log)
        except DamagedLog as error:
            damage = str(error)

    check_interface(parameters)
    wire = parameters.make_wire()
    identifiers = [*wire.identifiers, EmulatorFrames(parameters.node, wire).truth_id]
    try:
        with opened_bus(parameters) as bus, working("sending"):
            sent = play(of_the_board(frames(), identifiers), bus, options.speed)
    except (can.CanError, OSError) as error:
        place = f"CAN {parameters.interface} {parameters.channel}"
        raise CommandFailed(f"{place}: {error}; straightcomp doctor says what CAN this machine has") from error
    if not sent:
        raise CommandFailed(damage or f"log '{options.log}': has no frame of board {parameters.node}", exit_code=2)
    if damage:
        notes.print(f"{damage}; played up to there")
    if options.json:
        print_json({"sent": sent, "damaged": bool(damage)})
    else:
        notes.print(f"{sent} frames sent")
