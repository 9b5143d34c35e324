"""Make a map from a survey: a bag (stage X and a displacement sensor), a CSV recording over time, or a survey file.

Recognises runs and their directions, rejects spikes and runs that do not agree, reports repeatability in the way of
ISO 230-2, and writes the map with its provenance. `feedforward` takes the file as `stage.guide.file`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from straightcomp_ros.cli.law_tables import figures_table
from straightcomp_ros.cli.options import PICTURES, add_force, check_range, output_file
from straightcomp_ros.cli.output import CommandFailed, console, noted_warnings, notes, print_json
from straightcomp_ros.contract import DISPLACEMENT, ENCODER, STAGE

if TYPE_CHECKING:
    from straightcomp_ros.analysis.map_building import BuiltMap

SUMMARY = "map from a bag of survey runs, or from CSV"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="SOURCE", help="bag, or CSV file")
    add("--output", "-o", metavar="FILE", help="write the map (CSV); without it nothing is written")
    add_force(parser)
    add("--step", type=float, default=10.0, metavar="MM", help="length that makes one point (default: %(default)g)")
    add("--outliers", type=float, default=6.0, metavar="K", help="robust standard deviations (default: %(default)g)")
    add("--level", action="store_true", help="take the least squares line out, not only the mean")
    add("--plot", metavar="FILE", help="also save a plot (PNG, SVG or PDF)")
    for quantity in ("x", "deviation"):
        own = f"the CSV file's own name for the column of {quantity}, which ends with its unit"
        add(f"--{quantity}-column", metavar="NAME", help=own)
    add("--json", action="store_true", help="print one JSON object and nothing else")
    add = parser.add_argument_group("what to read from a bag").add_argument
    stage = f"x of the slider in m (default: {ENCODER.topic}:position[{STAGE}])"
    add("--stage", metavar="TOPIC[:FIELD]", default=ENCODER.topic, help=stage)
    sensor = "reading of the displacement sensor, e.g. /probe:range or /probe:point.y"
    sensor += f" (default: {DISPLACEMENT.topic}:position[{DISPLACEMENT.topic}])"
    add("--sensor", metavar="TOPIC[:FIELD]", default=DISPLACEMENT.topic, help=sensor)
    add("--unit", choices=("m", "mm", "um", "nm"), default="m", help="of the readings (default: %(default)s)")
    add("--invert", action="store_true", help="the reading falls when the slider moves towards +y")
    add("--delay", type=float, default=0.0, metavar="MS", help="age of a reading at its stamp (default: %(default)g)")
    add("--on-platform", action="store_true", help="the sensor rides on the platform: its y is taken off the reading")


def run(options: argparse.Namespace) -> None:
    from straightcomp_ros.straightness.survey import SurveyError

    for name, low, high in (("step", 0.01, 1000.0), ("outliers", 2.0, 1e6), ("delay", -1000.0, 1000.0)):
        check_range(f"--{name}", getattr(options, name), low, high)
    output, plot = output_file(options, "--output"), output_file(options, "--plot", PICTURES)
    with noted_warnings(UserWarning) as texts:
        try:
            built = _built(options)
        except SurveyError as error:
            # The survey is this tool's work, no option: exit code 1.
            raise CommandFailed(str(error)) from error
    if output is not None:
        built.write(output)
    if plot is not None:
        from straightcomp_ros.analysis.pictures import plot_map

        plot_map(built, plot)
    if options.json:
        print_json({**_as_json(built), "output": options.output, "warnings": texts})
    else:
        _print(built, options.output)


def _built(options: argparse.Namespace) -> BuiltMap:
    from straightcomp_ros.analysis.map_building import (
        Choices,
        Sensor,
        build,
        build_from_series,
        is_series,
        series_of_bag,
        series_of_csv,
    )
    from straightcomp_ros.bags.fields import Field
    from straightcomp_ros.bags.folder import STORED
    from straightcomp_ros.straightness.survey import SurveyError, read_survey

    choices = Choices(step=options.step * 1e-3, limit=options.outliers, level=options.level)
    source = Path(options.source)
    if not source.exists():
        raise SurveyError(f"survey {source} does not exist; give a bag or a CSV file")
    if source.is_dir() or STORED.fullmatch(source.name):
        try:
            stage = Field.parsed(options.stage, f"position[{STAGE}]")
            readings = Field.parsed(options.sensor, Sensor().readings.path)
        except ValueError as error:
            raise CommandFailed(f"--stage or --sensor: {error}", exit_code=2) from error
        sensor = Sensor(readings, options.unit, options.invert, options.delay * 1e-3, options.on_platform)
        return build_from_series(series_of_bag(source, stage, sensor), source, choices)
    own = {"x": options.x_column, "deviation": options.deviation_column}
    names = {quantity: name for quantity, name in own.items() if name is not None}
    if is_series(source, names):
        return build_from_series(series_of_csv(source, names), source, choices)
    parameters = choices.parameters
    survey = read_survey(source, min_points=parameters.min_points, max_gap=parameters.max_gap, names=names)
    return build(survey, source, choices)


def _as_json(built: BuiltMap) -> dict[str, Any]:
    found = built.repeatability

    def um(values: Any) -> list[float] | None:
        return None if values is None else (values * 1e6).tolist()

    return {
        **built.figures(),
        "provenance": dict(built.provenance),
        "runs": [
            {
                "name": passage.run.name,
                "direction": passage.run.direction,
                "start_s": passage.start,
                "duration_s": passage.duration,
                "points": int(passage.run.x.size),
                "at_rest": passage.at_rest,
                "samples": passage.samples,
                "rejected_samples": passage.spikes,
                "rejected": f"{passage.run.name} {passage.run.direction}" in built.rejected_runs,
            }
            for passage in built.passages
        ],
        "rejected_run_names": list(built.rejected_runs),
        "rejected_point_list": [{"run": run, "x_mm": x * 1e3} for run, x in built.rejected_points],
        "x_mm": (found.x * 1e3).tolist(),
        "mean_um": um(built.mean),
        "forward_s_um": um(found.forward.s if found.forward else None),
        "backward_s_um": um(found.backward.s if found.backward else None),
        "reversal_um": um(found.reversal),
    }


def _print(built: BuiltMap, output: str | None) -> None:
    console.print(figures_table(f"Survey {built.survey.source}", built.figures()))
    for name in built.rejected_runs:
        notes.print(f"run {name} is rejected: it differs from the others")
    for name, x in built.rejected_points[:20]:
        notes.print(f"run {name}: the point at x = {x * 1e3:.1f} mm is rejected")
    if len(built.rejected_points) > 20:
        notes.print(f"and {len(built.rejected_points) - 20} more points")
    if built.repeatability.short_of_the_standard:
        notes.print("ISO 230-2 asks for five runs each way: the repeatability is less certain")
    if output:
        notes.print(f"map: {output}")
