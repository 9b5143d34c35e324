"""Make a survey (CSV) of what an instrument or a controller has written.

The signs differ from maker to maker: after a conversion, compare one point with the instrument's own display, and
use --negate if it has the other sign."""

from __future__ import annotations

import argparse
from pathlib import Path

from straightcomp_ros.cli.output import console, output_file, print_json
from straightcomp_ros.cli.table_options import add_table_options, chosen_conventions
from straightcomp_ros.straightness.survey import write_survey
from straightcomp_ros.straightness.tables.formats import format_of

SUMMARY = "make a survey of an instrument's or a controller's file"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="what the instrument or the controller has written")
    parser.add_argument("--output", "-o", required=True, metavar="FILE", help="survey to write (CSV)")
    add_table_options(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> None:
    """Convert and print what the survey holds."""
    conventions = chosen_conventions(options)
    source, output = Path(options.file), output_file("--output", options.output)
    table = format_of(source, options.format).read(source, conventions)
    survey = (table.negated() if options.negate else table).to_survey(str(source))
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
