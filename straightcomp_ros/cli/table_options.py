"""Options of all tools that read or write error tables of controllers."""

from __future__ import annotations

import argparse

from straightcomp_ros.cli.output import CommandFailed, check_range
from straightcomp_ros.straightness.tables.error_table import UNITS, Conventions
from straightcomp_ros.straightness.tables.formats import FORMATS


def add_table_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    endings = ", ".join(f"{one.ending} {name}" for name, one in FORMATS.items())
    add("--format", choices=FORMATS, help=f"format (default: by the file's ending: {endings})")
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
