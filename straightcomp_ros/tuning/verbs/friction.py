"""Estimate friction, mass and stiffness of the plant from a bag, with 95 % confidence intervals.

Uses the streams `encoder` and `command` only, never `truth`. Position and current determine all forces only up to a
common factor: mass or coil turns must be known (--known), and are taken from the parameters, as the magnets' area and
bias current are: from those attached to the bag, unless --stage or --params-file names others. A stroke along a good
guide says little about mass and viscous friction; --excitation writes a map whose reference excites them:

  straightcomp friction --excitation waves.csv
  straightcomp simulate --set stage.guide.file=waves.csv --set driver.simulated.truth.guide=waves.csv --bag BAG
                                                                            (or run it on the machine)
  straightcomp friction BAG -o plant.yaml
  straightcomp simulate --stage plant.yaml

The command that --excitation prints has the --stage, --params-file, --law and --set of this one. An estimate has the
plant alone: with a stage file of your own put its values into that.
"""

import argparse
import math
import shlex
from pathlib import Path
from shlex import quote
from typing import Any

from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.bags.reader import read_attachments
from straightcomp_ros.bags.recorded_nodes import recorded_parameters
from straightcomp_ros.cli.options import (
    add_force,
    add_json,
    add_parameter_options,
    add_repeatable,
    chosen_changes,
    chosen_parameters,
    output_file,
)
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, print_written, working
from straightcomp_ros.cli.results import titled_table
from straightcomp_ros.parameters.declaration import ParameterError, to_mapping, under
from straightcomp_ros.parameters.node_parameters import STAGE, changed, node_parameters
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.parameter_file import DEFAULT_STAGE, as_yaml
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.survey import write_survey
from straightcomp_ros.tuning.identification.estimate import (
    UNITS,
    Estimate,
    Estimated,
    estimate_from_bag,
    excitation,
    parameter_file,
)

SUMMARY = "estimate the plant's friction, mass and stiffness from a bag"
PURPOSE = "tune"
_DEFAULT_KNOWN = "actuator.turns"
_EXCITATION_COMMENTS = (
    "Made up, not measured: a map for stage.guide.file that excites friction, mass and stiffness.",
    "Written by straightcomp friction --excitation.",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bag", nargs="?", metavar="BAG", help="rosbag2 folder or MCAP file")
    add_parameter_options(parser)
    known = f"hold this parameter at its value, e.g. platform.mass (default: {_DEFAULT_KNOWN})"
    add_repeatable(parser, "--known", "NAME", known)
    parser.add_argument("--output", "-o", metavar="FILE", help="write the parameters as a stage file")
    parser.add_argument("--excitation", metavar="FILE", help="write a map (CSV) that excites all parameters, and stop")
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Estimate and print, or write the map for the excitation."""
    if (options.bag is None) == (options.excitation is None):
        raise CommandFailed("allowed: either a BAG or --excitation FILE", exit_code=2)
    if options.excitation is not None:
        stage = node_parameters("driver", chosen_parameters(options)).stage
        file = output_file(options, "--excitation")
        waves, facts = excitation(stage)
        half = 0.5 * peak_to_peak(waves.runs[0].deviation)
        moves = f"The platform moves up to {half * 1e6:.0f} um to each side."
        write_survey(file, waves, (*_EXCITATION_COMMENTS, moves))
        if not options.json:
            # After the user's own: the last one counts.
            settings = [*options.set, f"stage.guide.file={file}", f"driver.simulated.truth.guide={file}"]
            own = to_mapping(stage)
            settings += [f"stage.{name}={as_yaml(value)}" for name, value in facts.items() if value != own[name]]
            given = {"--params-file": options.params_file, "--stage": options.stage, "--law": options.law}
            words = [word for option, value in given.items() if value for word in (option, value)]
            words += [word for setting in settings for word in ("--set", setting)]
            command = shlex.join(["straightcomp", "simulate", *words])
            print_written(file, then=f"{command} --bag BAG, or run it on the machine")
        return
    output = output_file(options, "--output")
    start = _start(options)
    with working("estimating") as advance:
        estimate = estimate_from_bag(Path(options.bag), start, options.known or [_DEFAULT_KNOWN], advance)
    if output is not None:
        write_whole(output, parameter_file(estimate))
    if options.json:
        print_json(_figures(estimate))
    else:
        _print(estimate)
        if output is not None:
            own = "put its values into your stage file, in the place of those there"
            print_written(output, then=f"{own}; without one: straightcomp simulate --stage {quote(str(output))}")


def _start(options: argparse.Namespace) -> StageParameters:
    """The description that the search starts from."""
    bag = Path(options.bag)
    if not (options.stage or options.params_file):
        driver = recorded_parameters(bag, read_attachments(bag)).get("driver")
        if driver is not None:
            # Without the rest: a board's DBC file need not be on this computer.
            values = {STAGE: under("stage.", driver), "driver": {}}
            try:
                return node_parameters("driver", changed(values, chosen_changes(options))).stage
            except ParameterError as error:
                raise ParameterError(f"bag {bag}: {error}; --stage FILE describes its stage otherwise") from error
        without = f"bag {bag}: has no parameters of the driver attached: the stage of {DEFAULT_STAGE} is assumed"
        notes.print(f"{without}; --stage FILE names another")
    return node_parameters("driver", chosen_parameters(options)).stage


def _figures(estimate: Estimate) -> dict[str, Any]:
    return {
        "samples": len(estimate.recording.y),
        "samples_in_bag": estimate.recording.total,
        "duration_s": estimate.recording.duration,
        "prediction_error_um": estimate.fit.rms_error_m * 1e6,
        "prediction_error_ratio": estimate.fit.solution.rms,
        "amplifier_bandwidth_Hz": estimate.path.rate / (2.0 * math.pi) if estimate.path.rate_found else None,
        **estimate.to_display(),
        "parameters": {
            name: {
                "value": found.value,
                "low": found.low,
                "high": found.high,
                "unit": UNITS[name],
                "known": found.known,
                "poorly_determined": found.poor,
                "hardly_told_apart_from": list(found.with_others),
            }
            for name, found in estimate.parameters.items()
        },
    }


def _print(estimate: Estimate) -> None:
    headings = ("parameter", "value", "95 % from", "to", "unit", "remark")
    rows = map(_row, estimate.parameters.values())
    table = titled_table("Plant parameters", *headings, left=("unit", "remark"), rows=rows)
    console.print(table)
    path, delays = estimate.path, [delay * 1e6 for delay in (estimate.path.delay, *estimate.path.delay_spread)]
    amplifier = "the current was interpolated: command and coil current fit no first-order amplifier"
    if not math.isnan(path.delay):
        source = "" if path.rate_found else " (from the parameters)"
        amplifier = (
            f"amplifier {path.rate / (2.0 * math.pi):.0f} Hz{source}, delay {delays[0]:.0f} µs "
            f"({delays[1]:.0f} to {delays[2]:.0f} µs in 90 % of the commands)"
        )
    notes.print(
        f"{len(estimate.recording.y)} of {estimate.recording.total} samples; one-step prediction error "
        f"{with_digits(estimate.fit.rms_error_m * 1e6, 3)} µm RMS; {amplifier}"
    )
    for sentence in ([str(estimate.centre)] if estimate.centre else []) + estimate.not_identifiable:
        notes.print(sentence)
    if any(found.poor for found in estimate.parameters.values()):
        notes.print("straightcomp friction --excitation FILE writes a map that identifies more")


def _row(found: Estimated) -> tuple[str, ...]:
    bounds, remark = (f"{found.low:.4g}", f"{found.high:.4g}"), ""
    if found.known:
        bounds, remark = ("", ""), "given"
    elif found.poor:
        others = f", hardly told apart from {', '.join(found.with_others)}" if found.with_others else ""
        remark = f"poorly determined by this bag{others}"
    return (found.name, f"{found.value:.4g}", *bounds, UNITS[found.name], remark)
