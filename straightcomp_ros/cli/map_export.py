"""Write the map as an error table for a machine controller that corrects by itself.

The table's correction is the map's reference: what has to be added to the platform's position. Before the first motion
compare its sign with a dial gauge; use --negate if the controller's axis counts the other way."""

import argparse

from straightcomp_ros.cli.map_convert import add_table_options, chosen_conventions
from straightcomp_ros.cli.options import add_force, check_range, output_file
from straightcomp_ros.cli.output import CommandFailed, console, print_json
from straightcomp_ros.parameters.whole_file import write_whole
from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from straightcomp_ros.straightness.tables.error_table import sampled
from straightcomp_ros.straightness.tables.formats import WRITTEN, format_of

SUMMARY = "write the map as a controller's error table"
_SMALLEST_SPACING_MM, _LARGEST_SPACING_MM = 0.1, 1000.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--output", "-o", required=True, metavar="FILE", help="error table to write")
    add("--survey", metavar="CSV", default=MapParameters.file, help="survey of the map (default: %(default)s)")
    add("--spacing", type=float, default=10.0, metavar="MM", help="distance of the points (default: %(default)s)")
    add_table_options(parser, tuple(WRITTEN))
    add_force(parser)
    add("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    """Export and print how well the table stands for the map."""
    conventions = chosen_conventions(options)
    check_range("--spacing", options.spacing, _SMALLEST_SPACING_MM, _LARGEST_SPACING_MM, "mm")
    output = output_file(options, "--output")
    table, error = sampled(load_map(MapParameters(file=options.survey)), options.spacing * 1e-3)
    write = format_of(output, options.format).write
    if write is None:
        raise CommandFailed(f"--output {output}: an instrument's file; allowed: {', '.join(WRITTEN)}", exit_code=2)
    written = write(table.negated() if options.negate else table, conventions)
    write_whole(output, written)
    figures = {
        "output": str(output),
        "points": len(table.x),
        "spacing_mm": float(table.x[1] - table.x[0]) * 1e3,
        "interpolation_error_um": error * 1e6,
    }
    if options.json:
        print_json(figures)
    else:
        console.print(
            f"{output}: {len(table.x)} points, {figures['spacing_mm']:g} mm apart; a controller that interpolates "
            f"linearly is at most {figures['interpolation_error_um']:.3f} µm beside the map"
        )
