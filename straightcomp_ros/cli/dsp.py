"""Be an encoder and DSP board on a CAN bus: the simulated machine, behind the frames that a real board sends.

The machine and the bus are those of the node `driver` in the parameter file (simulated.*, guide.*, can.*). With
can.firmware the board is the firmware core as a program. The executable `dsp_emulator` is the same."""

import argparse
import sys

from straightcomp_ros.cli import main as command_line
from straightcomp_ros.cli.options import add_parameter_options, chosen_parameters
from straightcomp_ros.cli.output import CommandFailed
from straightcomp_ros.hardware.can.hub_bus import INTERFACE
from straightcomp_ros.hardware.can.link import check_interface
from straightcomp_ros.parameters.node_parameters import node_parameters

SUMMARY = "emulate the DSP board on a CAN bus"
PURPOSE = "run"
_BUSES_OF_THE_FIRMWARE = ("socketcan", INTERFACE)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    hub = "be the hub of interface straightcomp_hub too, at the socket can.channel"
    parser.add_argument("--hub", action="store_true", help=hub)


def run(options: argparse.Namespace) -> int:
    """Be the board until SIGINT, SIGTERM or SIGHUP."""
    from straightcomp_ros.nodes.dsp_emulator import emulate

    parameters = node_parameters("driver", chosen_parameters(options))
    check_interface(parameters.can)
    interface = parameters.can.interface
    if options.hub and interface != INTERFACE:
        raise CommandFailed(f"--hub with can.interface '{interface}': allowed: {INTERFACE}", exit_code=2)
    if parameters.can.firmware and interface not in _BUSES_OF_THE_FIRMWARE:
        allowed = " or ".join(_BUSES_OF_THE_FIRMWARE)
        raise CommandFailed(f"can.firmware with can.interface '{interface}': allowed: {allowed}", exit_code=2)
    emulate(parameters, own_hub=options.hub)
    return 0


def main() -> int:
    """Entry point of the executable `dsp_emulator`."""
    return command_line.main(["dsp", *sys.argv[1:]])
