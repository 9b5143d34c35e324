"""Judge a recorded run: error, straightness by ISO 230-1, spectrum, timing, stick-slip, saturation, faults.

The bag may be unfinished. The exit code is 1 for a run that is not in order. With --limits the limits
decide: it is 1 when a figure is outside its limit, or the figures are not those of the whole motion, for use in CI."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from straightcomp_ros.analysis.figure_words import in_words, with_digits
from straightcomp_ros.cli.options import add_force, add_json, add_repeatable, in_range, output_file
from straightcomp_ros.cli.output import (
    CommandFailed,
    console,
    notes,
    print_json,
    print_warnings,
    print_written,
    working,
)
from straightcomp_ros.cli.results import fail_unless_in_order, marked, print_verdict, shown, titled_table
from straightcomp_ros.parameters.output_files import write_whole

if TYPE_CHECKING:
    from straightcomp_ros.analysis.assessment import Assessment

SUMMARY = "judge a recorded run, against limits if wanted"
PURPOSE = "judge"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bag", metavar="BAG", help="rosbag2 folder or MCAP file, finished or not")
    parser.add_argument("--compare", metavar="BAG2", help="compare its figures with those of another bag")
    parser.add_argument(
        "--limits", metavar="FILE", help="YAML file of limits: lines 'FIGURE: MAXIMUM' or 'FIGURE: {min: …, max: …}'"
    )
    parser.add_argument("--report", metavar="FILE", help="also write a report with interactive plots (one HTML file)")
    parser.add_argument(
        "--sensor-uncertainty",
        type=in_range(float, 0.0, 1e3, "µm"),
        metavar="UM",
        help="standard uncertainty of a recorded displacement sensor, to measure the guide by it in place of the map",
    )
    add_remap_option(parser)
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    from straightcomp_ros.analysis.assessment import checked_limits

    remap = parsed_remap(options.remap)
    sensor = None if options.sensor_uncertainty is None else options.sensor_uncertainty * 1e-6
    report = output_file(options, "--report")
    assessment = _assessed(Path(options.bag), remap, sensor)
    other = _assessed(Path(options.compare), remap, sensor) if options.compare else None
    if sensor is not None:
        _check_sensor(assessment, other)
    if other is not None and assessment.uncompensated != other.uncompensated:
        still = assessment.bag if assessment.uncompensated else other.bag
        text = "its error is that of a platform at rest; compare the straightness after compensation, not the errors"
        notes.print(f"{still} is uncompensated: {text}")
    figures = assessment.figures()
    checks = checked_limits(options.limits, figures) if options.limits else []
    failed = [str(check) for check in checks if not check.passed]
    if report is not None:
        from straightcomp_ros.analysis.html_report import report_html

        write_whole(report, report_html(assessment, other, checks))
        print_written(report, then="open it in a browser")
    if options.json:
        found = assessment.as_json()
        if other is not None:
            found["compared_with"] = other.as_json()
        if options.limits:
            found["failed_limits"] = failed
        print_json(found)
    else:
        _print(assessment, other)
        if checks and not failed:
            notes.print(f"all {len(checks)} limits are kept")
    if failed:
        raise CommandFailed("; ".join(failed))
    if not options.limits or assessment.partial:
        fail_unless_in_order(assessment.verdict)


def add_remap_option(parser: argparse.ArgumentParser) -> None:
    """Declare ``--remap``, which :func:`parsed_remap` reads."""
    add_repeatable(parser, "--remap", "OURS:=THEIRS", "the bag's topic for one of ours, e.g. encoder:=/machine/axes")


def parsed_remap(assignments: list[str]) -> dict[str, str]:
    """Topic of the bag by our name, from texts OURS:=THEIRS; CommandFailed for another form or an unknown OURS."""
    from straightcomp_ros.contract import STREAMS

    known = [stream.topic for stream in STREAMS]
    remap = {}
    for assignment in assignments:
        ours, _, theirs = assignment.partition(":=")
        if not theirs or ours not in known:
            allowed = f"OURS:=THEIRS with OURS one of {', '.join(known)}"
            raise CommandFailed(f"--remap {assignment!r}: allowed: {allowed}", exit_code=2)
        remap[ours] = theirs
    return remap


def _assessed(bag: Path, remap: dict[str, str], sensor: float | None) -> Assessment:
    from straightcomp_ros.analysis.assessment import assessed
    from straightcomp_ros.analysis.record import MetricsError

    try:
        with working("evaluating"):
            found = assessed(bag, remap, sensor)
    except MetricsError as error:
        raise CommandFailed(f"bag {bag}: {error}") from error
    print_warnings(found.warnings)
    return found


def _check_sensor(judged: Assessment, other: Assessment | None) -> None:
    from straightcomp_ros.contract import DISPLACEMENT

    readings = f"readings on '{DISPLACEMENT.topic}'"
    if judged.evaluation.guide is None:
        text = "without the option the straightness is that by the map"
        raise CommandFailed(f"bag {judged.bag}: --sensor-uncertainty: it has no {readings}; {text}")
    for one in (judged, other):
        if one is not None and not one.straightness:
            text = f"each stroke is too short, or has {readings} on less than nine tenths of its way"
            notes.print(f"{one.bag}: no straightness is stated: {text}")


def _print(assessment: Assessment, other: Assessment | None) -> None:
    title = f"{assessment.bag}, law '{assessment.evaluation.record.law}'"
    compared = (str(other.bag), "difference") if other is not None else ()
    table = titled_table(title, "figure", "value", *compared, "unit", left=("unit",))
    theirs = other.figures() if other is not None else {}
    words, other_words = assessment.verdict._asdict(), other.verdict._asdict() if other is not None else {}
    for name, value in assessment.figures().items():
        cells = [marked(name, shown(value), words)]
        if other is not None:
            another = theirs[name]
            difference = "" if value is None or another is None else shown(another - value)
            cells += [marked(name, shown(another), other_words), difference]
        if any(cells[:2]):
            what, unit = in_words(name)
            table.add_row(what, *cells, unit)
    console.print(table)
    headings = ("start s", "error p-p", "true p-p", "RMS", "before LS", "ends", "after LS", "ends")
    strokes = titled_table("Strokes: error and straightness (ISO 230-1) in µm", "stroke", *headings)
    names = ("encoder_pp_um", "true_pp_um", "encoder_rms_um", "before_least_squares_um", "before_end_points_um")
    for stroke in assessment.strokes:
        numbers = stroke.to_display()
        found = ((name, numbers[name]) for name in (*names, "after_least_squares_um", "after_end_points_um"))
        cells = (marked(name, "" if value is None else with_digits(value, 3), words) for name, value in found)
        strokes.add_row(stroke.direction, f"{stroke.start:.2f}", *cells)
    console.print(strokes)
    _print_straightness(assessment, words)
    print_verdict(assessment.verdict)
    if other is not None:
        print_verdict(other.verdict, str(other.bag))


def _print_straightness(assessment: Assessment, words: Mapping[str, Any]) -> None:
    from straightcomp_ros.analysis.straightness_statement import budget_rows

    rows = budget_rows(assessment.straightness)
    if not rows:
        return
    names = [in_words(name.removeprefix("u_"))[0] for name in rows[0]][4:]
    by = "sensor" if "u_sensor_um" in rows[0] else "map"
    title = f"Straightness by {by} and encoder in µm (ISO 230-1); U: expanded (k = 2)"
    table = titled_table(title, "straightness", "measured", "value", "U", *names)
    for what, *cells in (row.values() for row in rows):
        name = f"{what.split(',')[0]}_um"
        table.add_row(what, *(marked(name, cell or "", words) for cell in cells))
    console.print(table)
    if unknown := dict.fromkeys(name for one in assessment.straightness for name in one["unknown"]):
        notes.print(f"not known, and not in U: {', '.join(unknown)} (repeatability takes two strokes each way)")
