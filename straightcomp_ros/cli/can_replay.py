"""Send the frames of a recorded board again, at their recorded intervals, to a driver that listens.

LOG is a candump log, a BLF file, or another format of python-can. The bus, the board's DBC file and its node id are
those of the node `driver` in the parameter file (can.*). The host's frames in LOG are left out. The driver numbers and
dates the samples as it did then; with --speed other than 1 stage.rate has to be the recorded one times that speed."""

import argparse
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import can

from straightcomp_ros.cli.options import check_range
from straightcomp_ros.cli.output import CommandFailed, notes, print_json, working
from straightcomp_ros.cli.parameter_options import add_parameter_options, chosen_parameters
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frame_log import (
    DamagedLog,
    check_times_and_buses,
    of_the_board,
    play,
    recorded_frames,
)
from straightcomp_ros.hardware.can.link import check_interface, opened_bus
from straightcomp_ros.hardware.interface import HardwareError
from straightcomp_ros.parameters.node_parameters import node_parameters

SUMMARY = "send a recorded board's frames to a driver"
_SLOWEST, _FASTEST = 0.01, 100.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="LOG", type=Path, help="recorded frames: .log, .blf, .asc, .trc …")
    add_parameter_options(parser)
    parser.add_argument("--speed", type=float, default=1.0, help="speed of the play (default: as recorded)")
    parser.add_argument("--channel", metavar="NAME", help="bus in LOG whose frames are sent, if LOG has several")
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
            for frame in recorded_frames(options.log):
                if options.channel in (None, str(frame.channel)):
                    yield frame
        except DamagedLog as error:
            damage = str(error)

    check_interface(parameters)
    wire = parameters.make_wire()
    identifiers = [*wire.identifiers, EmulatorFrames(parameters.node, wire).truth_id]
    try:
        count, silences = check_times_and_buses(of_the_board(frames(), identifiers))
    except HardwareError as error:
        text = str(error)
        raise CommandFailed(text if text.startswith("log ") else f"log '{options.log}': {text}", exit_code=2) from error
    if not count:
        raise CommandFailed(damage or f"log '{options.log}': {_without_frames(frames(), parameters)}", exit_code=2)
    for silence in silences:
        notes.print(f"log '{options.log}': {silence}")
    try:
        with opened_bus(parameters) as bus, working("sending"):
            sent = play(of_the_board(frames(), identifiers), bus, options.speed)
    except (can.CanError, OSError) as error:
        place = f"CAN {parameters.interface} {parameters.channel}"
        raise CommandFailed(f"{place}: {error}; straightcomp doctor says what CAN this machine has") from error
    if damage:
        notes.print(f"{damage}; played up to there")
    if options.json:
        print_json({"sent": sent, "damaged": bool(damage)})
    else:
        notes.print(f"{sent} frames sent")


def _without_frames(frames: Iterator[can.Message], parameters: CanParameters) -> str:
    """Why a log has no frame of the board: the package's own has other frames on the other kind of bus."""
    if not parameters.dbc:
        other = dataclasses.replace(parameters, fd=not parameters.fd).make_wire()
        samples = {one.identifier for one in other.reports.values()}
        seen = sorted({frame.arbitration_id for frame in of_the_board(frames, samples)})
        if seen:
            bus = "CAN FD" if other.fd else "the classic bus"
            names = ", ".join(f"{one:#x}" for one in seen)
            return f"has frames of {bus} ({names}), but can.fd is {str(parameters.fd).lower()}"
    return f"has no frame of board {parameters.node}"
