"""Judge a recorded run: error, straightness by ISO 230-1, spectrum, timing, stick-slip, saturation, faults.

The bag may be unfinished. With --limits the exit code is 1 when a figure is outside its limit, for use in CI."""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from straightcomp_ros.cli.law_tables import shown
from straightcomp_ros.cli.output import CommandFailed, console, notes, output_file, print_json, working

if TYPE_CHECKING:
    from straightcomp_ros.analysis.assessment import Assessment, Verdict

SUMMARY = "judge a recorded run, against limits if wanted"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("bag", metavar="BAG", help="rosbag2 folder or MCAP file, finished or not")
    parser.add_argument("--compare", metavar="BAG2", help="put the figures of another bag beside it")
    parser.add_argument(
        "--limits", metavar="FILE", help="YAML file of limits: lines 'FIGURE: MAXIMUM' or 'FIGURE: {min: …, max: …}'"
    )
    parser.add_argument("--report", metavar="FILE", help="also write a report with interactive plots (one HTML file)")
    add_remap_option(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Judge and print."""
    from straightcomp_ros.analysis.assessment import LimitsError, judged, read_limits

    remap = parsed_remap(options.remap)
    report = output_file("--report", options.report) if options.report else None
    assessment = assessed(Path(options.bag), remap)
    other = assessed(Path(options.compare), remap) if options.compare else None
    figures = assessment.figures()
    verdicts: list[Verdict] = []
    if options.limits:
        try:
            verdicts = judged(read_limits(options.limits, figures), figures)
        except LimitsError as error:
            raise CommandFailed(str(error), exit_code=2) from error
    failed = [str(verdict) for verdict in verdicts if not verdict.passed]
    if report is not None:
        _write_report(report, assessment, other, verdicts)
    if options.json:
        found = assessment.as_json()
        if other is not None:
            found["compared_with"] = other.as_json()
        if options.limits:
            found["failed_limits"] = failed
        print_json(found)
    else:
        _print(assessment, other)
        if verdicts and not failed:
            notes.print(f"all {len(verdicts)} limits are kept")
    if failed:
        raise CommandFailed("; ".join(failed))
    return 0


def add_remap_option(parser: argparse.ArgumentParser) -> None:
    """Declare ``--remap``, which :func:`parsed_remap` reads."""
    parser.add_argument(
        "--remap",
        action="append",
        default=[],
        metavar="OURS:=THEIRS",
        help="the bag's topic for one of ours, e.g. encoder:=/machine/axes; may be repeated",
    )


def parsed_remap(assignments: list[str]) -> dict[str, str]:
    """Topic of the bag by our name, from texts OURS:=THEIRS.

    Raises:
        CommandFailed: another form, or a stream that is not ours.
    """
    from straightcomp_ros.contract import STREAMS

    known = [stream.topic for stream in STREAMS]
    remap = {}
    for assignment in assignments:
        ours, separator, theirs = assignment.partition(":=")
        if not separator or not theirs or ours not in known:
            raise CommandFailed(
                f"--remap {assignment!r}: allowed: OURS:=THEIRS with OURS one of {', '.join(known)}", exit_code=2
            )
        remap[ours] = theirs
    return remap


def assessed(bag: Path, remap: dict[str, str] | None = None) -> Assessment:
    """Read and judge a bag; what the reader warns of is printed once.

    Raises:
        CommandFailed: the bag is refused, or holds no stroke.
    """
    from straightcomp_ros.analysis.assessment import assess
    from straightcomp_ros.analysis.evaluation import evaluate_bag
    from straightcomp_ros.analysis.record import MetricsError
    from straightcomp_ros.bags import BagError

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            with working("evaluating"):
                assessment = assess(bag, evaluate_bag(bag, remap))
        except BagError as error:
            raise CommandFailed(str(error)) from error
        except MetricsError as error:
            raise CommandFailed(f"bag {bag}: {error}") from error
    texts = tuple(dict.fromkeys(str(warning.message) for warning in caught))
    for text in texts:
        notes.print(f"warning: {text}", style="yellow", soft_wrap=True)
    object.__setattr__(assessment, "warnings", texts)
    return assessment


def _write_report(path: Path, assessment: Assessment, other: Assessment | None, verdicts: list[Verdict]) -> None:
    from straightcomp_ros.analysis.html_report import report_html

    path.write_text(report_html(assessment, other, verdicts), encoding="utf-8")
    notes.print(f"report: {path}")


def _print(assessment: Assessment, other: Assessment | None) -> None:
    from rich.table import Table

    table = Table(title=f"{assessment.bag}, law '{assessment.evaluation.record.law}'", title_justify="left")
    table.add_column("figure", no_wrap=True)
    table.add_column("value", justify="right")
    if other is not None:
        table.add_column(f"{other.bag}", justify="right")
        table.add_column("difference", justify="right")
    theirs = other.figures() if other is not None else {}
    for name, value in assessment.figures().items():
        cells = [shown(value)]
        if other is not None:
            beside = theirs[name]
            both = value is not None and beside is not None
            cells += [shown(beside), shown(beside - value) if both else ""]
        if cells[0] or (other is not None and cells[1]):
            table.add_row(name, *cells)
    console.print(table)
    strokes = Table(title="Strokes: error and straightness (ISO 230-1) in µm", title_justify="left")
    for heading in ("stroke", "start s", "error p-p", "true p-p", "RMS", "before LS", "ends", "after LS", "ends"):
        strokes.add_column(heading, justify="left" if heading == "stroke" else "right", no_wrap=True)
    for stroke in assessment.strokes:
        numbers = stroke.to_display()
        names = ("encoder_pp", "true_pp", "encoder_rms", "before_least_squares", "before_end_points")
        columns = [numbers[f"{name}_um"] for name in (*names, "after_least_squares", "after_end_points")]
        strokes.add_row(
            stroke.direction, f"{stroke.start:.2f}", *(f"{v:.3f}" if v is not None else "" for v in columns)
        )
    console.print(strokes)
