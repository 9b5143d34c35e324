"""Make a survey (CSV) of what an instrument or a controller has written.

The signs differ from maker to maker: after a conversion, compare one point with the instrument's own display, and
use --negate if it has the other sign."""

import argparse
from collections.abc import Collection
from pathlib import Path

from straightcomp_ros.cli.options import add_force, check_range, output_file
from straightcomp_ros.cli.output import CommandFailed, console, print_json
from straightcomp_ros.straightness.survey import Survey, write_survey
from straightcomp_ros.straightness.tables.error_table import UNITS, Conventions
from straightcomp_ros.straightness.tables.formats import FORMATS, format_of

SUMMARY = "make a survey of an instrument's or a controller's file"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="what the instrument or the controller has written")
    parser.add_argument("--output", "-o", required=True, metavar="FILE", help="survey to write (CSV)")
    add_table_options(parser)
    add_force(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    conventions = chosen_conventions(options)
    source, output = Path(options.file), output_file(options, "--output")
    found = format_of(source, options.format).read(source, conventions)
    survey = found if isinstance(found, Survey) else found.to_survey(str(source))
    if options.negate:
        survey = survey.negated()
    write_survey(output, survey, [f"Converted from {source.name}"])
    first = survey.runs[0]
    figures = {
        "output": str(output),
        "points": len(first.x),
        "directions": [run.direction for run in survey.runs],
        "first_x_m": float(first.x[0]),
        "last_x_m": float(first.x[-1]),
        "peak_to_peak_um": float(max(run.deviation.max() for run in survey.runs) * 1e6)
        - float(min(run.deviation.min() for run in survey.runs) * 1e6),
    }
    if options.json:
        print_json(figures)
    else:
        console.print(
            f"{output}: {figures['points']} points from {first.x[0] * 1e3:g} to {first.x[-1] * 1e3:g} mm, "
            f"{figures['peak_to_peak_um']:.2f} µm peak to peak, {' and '.join(run.direction for run in survey.runs)}"
        )


def add_table_options(parser: argparse.ArgumentParser, formats: Collection[str] = tuple(FORMATS)) -> None:
    """Declare the options of all tools that read or write error tables of controllers, in one of ``formats``."""
    add = parser.add_argument
    endings = ", ".join(f"{FORMATS[name].ending} {name}" for name in formats)
    add("--format", choices=formats, help=f"format (default: by the file's ending: {endings})")
    unit = "length unit of the controller where the file does not say it: linuxcnc, aerotech (default: %(default)s)"
    add("--unit", choices=UNITS, default=Conventions.unit, help=unit)
    for axis, default in (("stage", Conventions.stage_axis), ("platform", Conventions.platform_axis)):
        number = f"the {axis}'s number in the controller, from 1: aerotech, crosscomp (default: %(default)s)"
        add(f"--{axis}-axis", type=int, default=default, metavar="N", help=number)
    error = "name of the straightness error after ISO 230-1: etalon (default: %(default)s)"
    add("--error", default=Conventions.error, metavar="NAME", help=error)
    add("--negate", action="store_true", help="turn the sign over, for an axis that counts the other way")


def chosen_conventions(options: argparse.Namespace) -> Conventions:
    """The conventions that the options name; CommandFailed with exit code 2 if an axis is not allowed."""
    for axis in ("stage", "platform"):
        check_range(f"--{axis}-axis", getattr(options, f"{axis}_axis"), 1)
    if options.stage_axis == options.platform_axis:
        raise CommandFailed(f"--stage-axis and --platform-axis: both {options.stage_axis}; allowed: two", exit_code=2)
    return Conventions(options.unit, options.stage_axis, options.platform_axis, options.error.upper())
