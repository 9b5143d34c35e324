"""Work on the map of the guide: import surveys of instruments and controllers, export the map."""

import argparse
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from straightcomp_ros.analysis.map_building import MAP, OUTLIERS, BuiltMap, Choices, agreeing, build
from straightcomp_ros.bags import noting_warnings
from straightcomp_ros.bags.fields import Field
from straightcomp_ros.bags.folder import STORED
from straightcomp_ros.cli import Tool
from straightcomp_ros.cli.options import (
    PICTURES,
    add_force,
    add_guide_option,
    add_json,
    add_repeatable,
    chosen_guide,
    in_range,
    output_file,
)
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, print_warnings, print_written
from straightcomp_ros.cli.results import figures_table
from straightcomp_ros.contract import DISPLACEMENT, ENCODER, STAGE
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, find_survey, load_map
from straightcomp_ros.straightness.residual import rms
from straightcomp_ros.straightness.survey import Run, Survey, check_run, read_survey, write_survey
from straightcomp_ros.straightness.survey_header import WAYS, SurveyError
from straightcomp_ros.straightness.survey_table import MARK
from straightcomp_ros.tuning.survey.alignment import align
from straightcomp_ros.tuning.survey.error_table import UNITS, Conventions, sampled
from straightcomp_ros.tuning.survey.formats import FORMATS, WRITTEN, format_of, written
from straightcomp_ros.tuning.survey.recording import (
    Passage,
    Sensor,
    Series,
    build_from_series,
    recognise,
    series_of_bag,
    series_of_csv,
)
from straightcomp_ros.tuning.survey.separation import separated

SUMMARY = "build the map of the guide from a survey, convert surveys, export a controller's error table"
PURPOSE = "set up"
_REJECTED = "is rejected: it differs from the others, or its outliers leave too little of it"
_OF_BAG = ("position", "sensor", "unit", "delay", "on_platform")
_OF_CSV = ("x_column", "deviation_column")
"""Options that say how one kind of source is read, None where they are not given."""
_STEP = "length that makes one point (default: %(default)g)"


def _build_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="SOURCE", help="bag, or CSV file")
    add("--output", "-o", metavar="FILE", help="write the map (CSV); without it nothing is written")
    add_force(parser)
    add("--step", type=in_range(float, 0.01, 1000.0), default=10.0, metavar="MM", help=_STEP)
    add(
        "--outliers",
        type=in_range(float, 2.0, 1e6),
        default=OUTLIERS,
        metavar="K",
        help="robust standard deviations (default: %(default)g)",
    )
    add("--level", action="store_true", help="take the least squares line out, not only the mean")
    smooth = (
        f"auto, none or a factor of auto: how much noise the map leaves out (default: the stage's, or {MAP.smooth})"
    )
    add("--smooth", metavar="HOW", help=smooth)
    add("--plot", metavar="FILE", help="also save a plot (PNG, SVG or PDF)")
    for quantity in ("x", "deviation"):
        own = f"the CSV file's own name for the column of {quantity}, which ends with its unit"
        add(f"--{quantity}-column", metavar="NAME", help=own)
    _add_notes(parser)
    add_guide_option(parser)
    add_json(parser)
    _add_sensor(parser)


def _add_notes(parser: argparse.ArgumentParser) -> None:
    """Declare ``--note``."""
    text = f"a line for the head of the file: instrument, machine, operator, {MARK!r} …"
    add_repeatable(parser, "--note", "NAME=TEXT", text)


def _noted(options: argparse.Namespace) -> dict[str, str]:
    """The ``--note``s by name."""
    notes = [note.partition("=") for note in options.note]
    for name, equals, text in notes:
        if not (equals and name.strip() and text.strip()) or ": " in name or not (name + text).isprintable():
            raise CommandFailed(f"--note {name + equals + text!r}; allowed: NAME=TEXT on one line", exit_code=2)
    return {name.strip(): text.strip() for name, _, text in notes}


def _add_sensor(parser: argparse.ArgumentParser) -> None:
    """Declare how the stage's x and the sensor are read."""
    sign = "the reading falls when the slider moves towards +y: its sign is turned over, also in a CSV file"
    parser.add_argument("--invert", action="store_true", help=sign)
    add = parser.add_argument_group("what to read from a bag").add_argument
    stage = f"x of the slider in m (default: {ENCODER.topic}:position[{STAGE}]; formerly --stage)"
    add("--position", "--stage", metavar="TOPIC[:FIELD]", help=stage)
    sensor = "reading of the displacement sensor, e.g. /probe:range or /probe:point.y"
    sensor += f" (default: {DISPLACEMENT.topic}:position[{DISPLACEMENT.topic}])"
    add("--sensor", metavar="TOPIC[:FIELD]", help=sensor)
    add("--unit", choices=("m", "mm", "um", "nm"), help=f"of the readings (default: {Sensor.unit})")
    delay = f"age of a reading at its stamp (default: {Sensor.delay:g})"
    add("--delay", type=in_range(float, -1000.0, 1000.0), metavar="MS", help=delay)
    platform = "the sensor rides on the platform: its y is taken off the reading"
    add("--on-platform", action="store_true", default=None, help=platform)


def _build(options: argparse.Namespace) -> None:
    """Make a map from a survey: a bag (stage X and a displacement sensor), a CSV recording over time, or a survey file.

    Recognises runs and their directions, rejects spikes and runs that do not agree, reports repeatability in the way of
    ISO 230-2, and writes the map with its provenance. `feedforward` takes the file as `stage.guide.file`."""
    output, plot = output_file(options, "--output"), output_file(options, "--plot", PICTURES)
    with noting_warnings() as texts:
        guide = chosen_guide(options)
        built, passages = _built(options, guide)
    print_warnings(texts)
    if output is not None:
        built.write(output)
    if plot is not None:
        from straightcomp_ros.analysis.map_page import plot_map

        plot_map(built, plot)
    if options.json:
        print_json({**_in_json(built, passages), "output": options.output, "warnings": texts})
        return
    console.print(figures_table(f"Survey {built.straightness.survey.source}", built.figures()))
    for name in built.rejected_runs:
        notes.print(f"run {name} {_REJECTED}")
    for name, x in built.rejected_points[:20]:
        notes.print(f"run {name}: the point at x = {x * 1e3:.1f} mm is rejected")
    if len(built.rejected_points) > 20:
        notes.print(f"and {len(built.rejected_points) - 20} more points")
    notes.print(str(built.straightness.noise))
    if built.straightness.directed:
        notes.print(
            f"hysteresis of up to {built.straightness.hysteresis * 1e6:.2g} µm is more than the noise: the map has a "
            "table for each direction"
        )
    if options.smooth not in (None, guide.smooth):
        notes.print(f"the file has the runs as measured: set stage.guide.smooth to {options.smooth} for this map")
    if built.straightness.report.short_of_the_standard:
        notes.print("ISO 230-2 asks for five runs each way: the repeatability is less certain")
    if output is not None or plot is not None:
        then = "-o FILE writes the map"
        if output is not None:
            new = f"straightcomp stage new FOLDER --survey {quote(str(output))}"
            then = f"{new}, or name the map in a stage's stage.guide.file"
        print_written(*filter(None, (output, plot)), then=then)


def _built(options: argparse.Namespace, guide: MapParameters) -> tuple[BuiltMap, tuple[Passage, ...]]:
    try:
        guide = replace(guide, smooth=options.smooth or guide.smooth)
    except ParameterError as error:
        raise CommandFailed(f"--smooth: {error}", exit_code=2) from error
    choices = Choices(options.step * 1e-3, options.outliers, options.level, guide)
    source, noted = Path(options.source), _noted(options)
    read = _read(source, options, guide)
    try:
        if isinstance(read, Series):
            return build_from_series(read, source, choices, noted)
        return build(replace(read, facts={**read.facts, **noted}), source, choices), ()
    except SurveyError as error:
        # What was read can be no map: this tool's own finding, no wrong use.
        raise CommandFailed(str(error)) from error


def _read(source: Path, options: argparse.Namespace, guide: MapParameters) -> Series | Survey:
    """What a bag or a CSV file has recorded over time, or the survey in a file as ``guide`` demands it."""
    if not source.exists():
        raise CommandFailed(f"survey {source} does not exist; give a bag or a CSV file", exit_code=2)
    bag = source.is_dir() or STORED.fullmatch(source.name)
    for name in _OF_CSV if bag else _OF_BAG:
        if getattr(options, name, None) is not None:
            kinds = ("CSV files", "bag") if bag else ("bags", "CSV file, whose header says what its columns are")
            raise CommandFailed(f"--{name.replace('_', '-')}: for {kinds[0]}; {source} is a {kinds[1]}", exit_code=2)
    if bag:
        delay = options.delay or Sensor.delay
        try:
            stage = Field.parsed(options.position or ENCODER.topic, f"position[{STAGE}]")
            readings = Field.parsed(options.sensor or DISPLACEMENT.topic, Sensor().readings.path)
        except ValueError as error:
            raise CommandFailed(f"--position or --sensor: {error}", exit_code=2) from error
        unit, on_platform = options.unit or Sensor.unit, bool(options.on_platform)
        return series_of_bag(source, stage, Sensor(readings, unit, options.invert, delay * 1e-3, on_platform))
    own = ((quantity, getattr(options, f"{quantity}_column", None)) for quantity in ("x", "deviation"))
    names = {quantity: name for quantity, name in own if name is not None}
    read = series_of_csv(source, names) or _survey(source, guide, names)
    if not options.invert:
        return read
    if isinstance(read, Series):
        return replace(read, deviation=-read.deviation, inputs={**read.inputs, "sign": "inverted"})
    return replace(_negated(read), facts={**read.facts, "sign": "inverted"})


def _survey(source: str | Path, guide: MapParameters, names: Mapping[str, str] | None = None) -> Survey:
    """The survey in a file as ``guide`` demands it."""
    return read_survey(source, min_points=guide.min_points, max_gap=guide.max_gap, names=names)


def _negated(survey: Survey) -> Survey:
    return replace(survey, runs=tuple(replace(run, deviation=-run.deviation) for run in survey.runs))


def _in_json(built: BuiltMap, passages: Sequence[Passage]) -> dict[str, Any]:
    found, runs = built.straightness.report, []
    for passage in passages:
        run, figures = passage.run, passage._asdict()
        del figures["run"]
        figures |= {"points": run.x.size, "rejected": f"{run.name} {run.direction}" in built.rejected_runs}
        runs.append({"name": run.name, "direction": run.direction, **figures})
    um = {
        "mean_um": found.mean,
        "forward_s_um": found.forward and found.forward.s,
        "backward_s_um": found.backward and found.backward.s,
        "reversal_um": found.reversal,
        "map_um": built.straightness.deviations(found.x),
        **{f"map_{way}_um": built.straightness.deviations(found.x, way) for way in WAYS if built.straightness.directed},
        "map_s_um": built.straightness.noise.band(found.x),
    }
    return {
        **built.figures(),
        "provenance": dict(built.provenance),
        "runs": runs,
        "rejected_run_names": list(built.rejected_runs),
        "rejected_point_list": [{"run": run, "x_mm": x * 1e3} for run, x in built.rejected_points],
        "x_mm": (found.x * 1e3).tolist(),
        **{name: None if values is None else (values * 1e6).tolist() for name, values in um.items()},
    }


def _convert_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="what the instrument or the controller has written")
    parser.add_argument("--output", "-o", required=True, metavar="FILE", help="survey to write (CSV)")
    _add_table_options(parser, FORMATS)
    add_force(parser)
    add_json(parser)


def _convert(options: argparse.Namespace) -> None:
    """Make a survey (CSV) of what an instrument or a controller has written.

    The signs differ from maker to maker: after a conversion, compare one point with the instrument's own display, and
    use --negate if it has the other sign."""
    conventions = _chosen_conventions(options)
    source, output = Path(options.file), output_file(options, "--output")
    survey = FORMATS[format_of(source, options.format)].read(source, conventions)
    for run in survey.runs:
        check_run(f"survey {source}, run '{run.name}' {run.direction}", run)
    if options.negate:
        survey = _negated(survey)
    write_survey(output, survey, [f"Converted from {source.name}"])
    x, deviation = survey.runs[0].x, np.concatenate([run.deviation for run in survey.runs])
    figures = {
        "output": str(output),
        "points": len(x),
        "directions": [run.direction for run in survey.runs],
        "first_x_m": float(x[0]),
        "last_x_m": float(x[-1]),
        "peak_to_peak_um": float(deviation.max() * 1e6) - float(deviation.min() * 1e6),
    }
    if options.json:
        print_json(figures)
    else:
        console.print(
            f"{output}: {len(x)} points from {x[0] * 1e3:g} to {x[-1] * 1e3:g} mm, "
            f"{figures['peak_to_peak_um']:.2f} µm peak to peak, {' and '.join(run.direction for run in survey.runs)}"
        )
        print_written(output, then=f"straightcomp map build {quote(str(output))} -o map.csv")


def _add_table_options(parser: argparse.ArgumentParser, formats: Collection[str]) -> None:
    """Declare the options of a tool that reads or writes files of these ``formats``."""
    add = parser.add_argument
    endings = ", ".join(f"{FORMATS[name].ending} {name}" for name in formats)
    add("--format", choices=formats, help=f"format (default: by the file's ending: {endings})")
    unit = "length unit of the controller where the file does not say it: linuxcnc, aerotech (default: %(default)s)"
    add("--unit", choices=UNITS, default=Conventions.unit, help=unit)
    for axis, default in (("stage", Conventions.stage_axis), ("platform", Conventions.platform_axis)):
        place = f"the {axis}'s number in the controller, from 1: aerotech, crosscomp (default: %(default)s)"
        add(f"--{axis}-axis", type=in_range(int, 1), default=default, metavar="N", help=place)
    error = "name of the straightness error after ISO 230-1: etalon (default: %(default)s)"
    add("--error", default=Conventions.error, metavar="NAME", help=error)
    add("--negate", action="store_true", help="turn the sign over, for an axis that counts the other way")


def _chosen_conventions(options: argparse.Namespace) -> Conventions:
    """The conventions that the options name; CommandFailed with exit code 2 if an axis is not allowed."""
    if options.stage_axis == options.platform_axis:
        raise CommandFailed(f"--stage-axis and --platform-axis: both {options.stage_axis}; allowed: two", exit_code=2)
    return Conventions(options.unit, options.stage_axis, options.platform_axis, options.error.upper())


def _export_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--output", "-o", required=True, metavar="FILE", help="error table to write")
    add("--survey", metavar="CSV", help=f"survey of the map (default: the stage's, or {MapParameters.file})")
    spacing = "distance of the points (default: %(default)s)"
    add("--spacing", type=in_range(float, 0.1, 1000.0, "mm"), default=10.0, metavar="MM", help=spacing)
    _add_table_options(parser, WRITTEN)
    add_guide_option(parser)
    add_force(parser)
    add_json(parser)


def _export(options: argparse.Namespace) -> None:
    """Write the map as an error table for a machine controller that corrects by itself.

    The table's correction is the map's reference: what has to be added to the platform's position. Before the first
    motion compare its sign with a dial gauge; use --negate if the controller's axis counts the other way."""
    conventions = _chosen_conventions(options)
    guide = chosen_guide(options)
    # Before the output is named: the survey is an input of this command, also where no option names it.
    options.survey = options.survey or guide.file
    output = output_file(options, "--output")
    straightness = load_map(replace(guide, file=options.survey))
    points, error = sampled(straightness, options.spacing * 1e-3)
    name = format_of(output, options.format)
    if name not in WRITTEN:
        raise CommandFailed(f"--output {output}: an instrument's file; allowed: {', '.join(WRITTEN)}", exit_code=2)
    sign = -1.0 if options.negate else 1.0
    write_whole(
        output,
        written(name, [(x, *(sign * deviation for deviation in ways)) for x, *ways in points.tolist()], conventions),
    )
    figures = {
        "output": str(output),
        "survey": str(find_survey(options.survey)),
        "points": len(points),
        "spacing_mm": float(points[1, 0] - points[0, 0]) * 1e3,
        "interpolation_error_um": error * 1e6,
        "directions": len(points[0]) - 1 if FORMATS[name].directed else 1,
    }
    if options.json:
        print_json(figures)
    else:
        console.print(
            f"{output}: {len(points)} points, {figures['spacing_mm']:g} mm apart, of the survey {options.survey}; a "
            f"controller that interpolates linearly is at most {figures['interpolation_error_um']:.3f} µm off the map"
        )
        if points.shape[1] - 1 > figures["directions"]:
            notes.print(f"the guide has hysteresis; {name} has one table for both directions: it is their mean")
        then = "load it into the controller, and compare its sign with a dial gauge"
        # Also a copy, as of `stage new`.
        if straightness.survey.digest == read_survey(find_survey(MapParameters.file)).digest:
            then = f"{options.survey} is the synthetic survey: name that of your guide with --survey"
        print_written(output, then=then)


def _reverse_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("normal", metavar="SURVEY_NORMAL", help="survey with the straightedge as it was")
    add("second", metavar="SURVEY_2", help="survey with straightedge and sensor turned over, or with one of them moved")
    add("--output", "-o", required=True, metavar="FILE", help="survey of the guide to write (CSV)")
    add("--edge", metavar="FILE", help="also write the straightedge's own deviation, as a survey")
    moved = "SURVEY_2 is not turned over, but moved by this towards larger x"
    add("--shift", type=in_range(float, -10_000.0, 10_000.0), metavar="MM", help=moved)
    moved = "what was moved by --shift (default: %(default)s)"
    add("--moved", choices=("straightedge", "sensor"), default="straightedge", help=moved)
    add_guide_option(parser)
    add_force(parser)
    add_json(parser)


def _reverse(options: argparse.Namespace) -> None:
    """Separate guide and straightedge by two surveys, the second with the straightedge turned over about its long axis
    and the sensor on the other side; or, with --shift, with the straightedge or the sensor moved along x.

    Turned over, the readings of the second survey keep the sensor's own sign: guide = (m1 − m2) / 2, edge =
    (m1 + m2) / 2. If its deviations have the sign of the machine's axis, turn it over before, with `map convert
    --negate` or `map build --invert`."""
    output, edge, shift = output_file(options, "--output"), output_file(options, "--edge"), options.shift
    guide = chosen_guide(options)
    normal, second = _survey(options.normal, guide), _survey(options.second, guide)
    try:
        found = separated(normal, second, None if shift is None else shift * 1e-3, options.moved, guide)
    except SurveyError as error:
        raise CommandFailed(str(error)) from error
    names = f"{Path(options.normal).name} and {Path(options.second).name}"
    how = "straightedge reversal" if shift is None else f"a shift of the {options.moved} by {shift:g} mm"
    pairs = len(found.guide.survey.runs)
    figures: dict[str, Any] = {"points": len(found.x), "pairs": pairs, "left_out_runs": found.left_out}
    for name, (_, _, s, lines) in (("guide", found.guide), ("edge", found.edge)):
        for one in lines:
            figures[f"{name}_{one.line}_um"] = one.value * 1e6
            figures[f"{name}_{one.line}_U_um"] = None if one.unknown else one.expanded_uncertainty * 1e6
        figures[f"{name}_standard_uncertainty_um"] = None if s is None else rms(s) * 1e6
    kept = [f"{name}: {text}" for name, text in normal.facts.items()]
    write_survey(output, found.guide.survey, [*kept, f"separated by: {how}, guide of {names}"])
    if edge is not None:
        write_survey(edge, found.edge.survey, [*kept, f"separated by: {how}, straightedge of {names}"])
    if options.json:
        print_json({"output": str(output), **figures})
        return
    console.print(figures_table(f"Guide and straightedge, by {how}: {names}", figures))
    if found.guide.s is None:
        notes.print("without repeated runs the noise is not known; repeat the runs of both surveys")
    if shift is not None:
        blind = f"waves of {abs(shift):g} mm and of a half, a third … of it"
        also = "" if options.moved == "sensor" else ", and its parabola"
        notes.print(f"not seen, and left in the guide: the straightedge's {blind}{also}")
    print_written(*filter(None, (output, edge)), then=f"straightcomp map build {quote(str(output))} -o map.csv")


def _align_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("survey", metavar="SURVEY", help="survey of the map (CSV)")
    add("sources", metavar="SOURCE", nargs="+", help="bag, or CSV file, of strokes with a displacement sensor")
    add("--output", "-o", metavar="FILE", help="write the survey corrected; without it nothing is written")
    reach = "largest shift to each side (default: %(default)g)"
    add("--reach", type=in_range(float, 0.1, 1000.0), default=20.0, metavar="MM", help=reach)
    add("--step", type=in_range(float, 0.01, 100.0), default=1.0, metavar="MM", help=_STEP)
    add("--residual", action="store_true", help="the readings are what is left with this map, not the guide itself")
    add("--tilt", action="store_true", help="correct the tilt too: the sensor's line becomes the map's")
    _add_notes(parser)
    add_guide_option(parser)
    add_force(parser)
    add_json(parser)
    _add_sensor(parser)


def _strokes(options: argparse.Namespace, guide: MapParameters) -> list[Run]:
    """The strokes of all sources that agree with the others of theirs."""
    strokes: list[Run] = []
    for source in map(Path, options.sources):
        read = _read(source, options, guide)
        if isinstance(read, Series):
            passages = recognise(read, options.step * 1e-3, OUTLIERS, guide.max_gap)[0]
            read = Survey(tuple(one.run for one in passages), str(source))
        kept, rejected, _ = agreeing(read, OUTLIERS, guide)
        strokes += kept
        for name in rejected:
            notes.print(f"{source}: run {name} {_REJECTED}")
    return strokes


def _align(options: argparse.Namespace) -> None:
    """Find zero and scale of a survey's x, its sign and its tilt, from a few strokes over the same guide with a
    displacement sensor, and write a corrected survey if asked to.

    The strokes cover most of the survey, best in both directions. A sensor that rides on the platform needs
    --on-platform, which takes the platform's own y off."""
    output, noted = output_file(options, "--output"), _noted(options)
    # What is not aligned yet may reach farther than the platform.
    guide = replace(chosen_guide(options), travel=MAP.travel)
    survey = _survey(options.survey, guide)
    straightness, strokes = StraightnessMap(survey, guide), _strokes(options, guide)
    if options.residual:
        strokes = [
            replace(run, deviation=run.deviation + straightness.deviations(run.x, run.direction)) for run in strokes
        ]
    try:
        found = align(straightness, strokes, options.reach * 1e-3)
    except SurveyError as error:
        raise CommandFailed(str(error)) from error
    figures: dict[str, Any] = {"strokes": len(strokes), "found": found.found, "sign": found.sign}
    units = {"shift_mm": 1e3, "scale_1e-6": 1e6, "gain": 1.0, "tilt_um_per_m": 1e6, "lag_mm": 1e3}
    for column, factor in units.items():
        one = getattr(found, column.partition("_")[0])
        figures |= {column: one and one.value * factor, f"{column}_95": one and one.half_width * factor}
    figures["middle_mm"] = found.middle * 1e3
    figures |= {"unexplained_before_rms_um": found.before * 1e6, "unexplained_after_rms_um": found.after * 1e6}
    differs = found.found and (found.differs or (options.tilt and found.tilt.seen))
    facts = dict(survey.facts)
    if differs:
        taken = f"shift {found.shift.value * 1e3:.4g} mm, scale {found.scale.value:.3g}, sign {found.sign}"
        by = f"straightcomp map align, from {', '.join(Path(source).name for source in options.sources)}: {taken}"
        facts = {name: text for name, text in facts.items() if name != MARK} | {"aligned by": by}
    # Also where it fits: what stands in the file is then that of these strokes, not of a former call.
    if found.found and output is not None:
        comments = [f"{name}: {text}" for name, text in (facts | noted).items()]
        write_survey(output, found.applied(survey, options.tilt), comments)
    if options.json:
        print_json({**figures, "output": options.output if found.found else None})
    else:
        console.print(figures_table(f"Survey {options.survey} in the machine", figures))
    if found.lag is None:
        notes.print("the strokes go one way only: a delay of the sensor is in the shift; record both directions")
    if found.changed:
        notes.print("more is left than the noise of sensor and survey: the guide has changed, or the sensor drifts")
    if found.ambiguous is not None:
        raise CommandFailed(
            f"a shift of {found.ambiguous * 1e3:.4g} mm explains the strokes as well as one of "
            f"{found.shift.value * 1e3:.4g} mm: nothing can be told; record longer strokes, or give a shorter --reach"
        )
    if not found.found:
        raise CommandFailed("the guide is too flat for this sensor: its strokes tell neither zero nor sign")
    if options.json:
        return
    if not differs:
        notes.print("the survey fits: no difference exceeds its 95 % interval; nothing to correct")
    if output is not None:
        print_written(output, then=f"straightcomp map build {quote(str(output))}, and name it in stage.guide.file")
    elif differs:
        notes.print("nothing is written: -o FILE writes the survey with what exceeds its 95 % interval corrected")


TOOLS = {
    "align": Tool("find zero, scale, sign and tilt of a survey by strokes with a sensor", _align_arguments, _align),
    "build": Tool("map from a bag of survey runs, or from CSV", _build_arguments, _build),
    "convert": Tool("make a survey of an instrument's or a controller's file", _convert_arguments, _convert),
    "export": Tool("write the map as a controller's error table", _export_arguments, _export),
    "reverse": Tool("separate guide and straightedge by reversal or by a shift", _reverse_arguments, _reverse),
}
