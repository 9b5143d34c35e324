"""Pack what is needed to understand an incident into one file, or open such a file.

`straightcomp incident BAG` packs the bag, finished or not, with parameters, map, certificate, diagnostics, the doctor's
findings, logs and versions; secrets are left out and named. `straightcomp incident open FILE` needs no ROS: it unpacks,
judges the run again, draws it, and computes every command again. The first line that both print is the cause."""

import argparse
import contextlib
import json
from datetime import datetime
from pathlib import Path
from shlex import quote

from straightcomp_ros.cli.options import add_force, add_json, in_range, output_file, output_folder
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, print_written, working
from straightcomp_ros.parameters.output_files import clear, write_whole

SUMMARY = "pack an incident into one file, or open one"
PURPOSE = "judge"
_OPEN = "open"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("bag", metavar="BAG", help="rosbag2 folder or MCAP file; or the word open")
    add("file", metavar="FILE", nargs="?", help="the incident to open")
    output = "the file, or with open the folder (default: incident_TIME.zip; FILE without its ending)"
    add("--output", "-o", metavar="PATH", help=output)
    last = "pack the last seconds of the bag, and what came before from the amplifier's switch-on (default: all)"
    add("--last", type=in_range(float, 0.0), default=0.0, metavar="SECONDS", help=last)
    add("--logs", metavar="DIR", help="folder of the nodes' logs (default: logs/ beside the bag)")
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    if (options.bag == _OPEN) != bool(options.file):
        raise CommandFailed("allowed: incident BAG, or incident open FILE", exit_code=2)
    (_open if options.file else _pack)(options)


def _pack(options: argparse.Namespace) -> None:
    from straightcomp_ros.doctor.computer import examine
    from straightcomp_ros.offline.incident import pack

    bag = Path(options.bag)
    options.output = options.output or f"incident_{datetime.now():%Y_%m_%d-%H_%M_%S}.zip"
    output = output_file(options, "--output", (".zip",))
    logs = Path(options.logs) if options.logs else None
    if logs is not None and not logs.is_dir():
        raise CommandFailed(f"--logs {logs}: is no folder", exit_code=2)
    assert output is not None
    with working("packing"):
        packed = pack(bag, output, examine(), last=options.last, logs=logs)
    if options.json:
        print_json({"file": str(output), "cause": packed.cause, "bytes": packed.size, "left_out": packed.left_out})
        return
    console.print(packed.cause)
    for one in packed.left_out:
        notes.print(f"left out: {one}")
    notes.print(f"{packed.size / 1e6:.1f} MB")
    print_written(output, then=f"straightcomp incident open {quote(str(output))}, on any computer")


def _open(options: argparse.Namespace) -> None:
    from straightcomp_ros.analysis.pictures import plot_run
    from straightcomp_ros.offline.incident import BAG, DOCTOR, IncidentError, incident_page, judged, summary, unpack

    file = Path(options.file)
    if not file.is_file():
        raise CommandFailed(f"{file}: is no file", exit_code=2)
    name = options.output or str(file.with_suffix(""))
    made, folder = not Path(name).exists(), output_folder("--output", name, empty=True)
    try:
        details = unpack(file, folder)
    except BaseException as error:
        if not isinstance(error, FileExistsError):  # of another process, which unpacks there
            clear(folder, made=made)
        if isinstance(error, IncidentError):
            raise CommandFailed(str(error), exit_code=2) from error
        raise
    logs = {one.name: one.read_text(errors="replace") for one in sorted(folder.glob("logs/*"))}
    with working("judging"):
        found = judged(folder / BAG, logs)
    picture = folder / "run.png"
    if (assessment := found.assessment) and assessment.evaluation.map:
        title = f"{details.get('bag')}: {found.cause}"
        with contextlib.suppress(ValueError):
            plot_run(assessment.record, assessment.evaluation.map, assessment.metrics, picture, title)
    doctor = json.loads((folder / DOCTOR).read_text(encoding="utf-8"))
    page = folder / "incident.html"
    write_whole(page, incident_page(found, details, doctor))
    if options.json:
        print_json({**found.to_json(), "folder": str(folder), "as_packed": details, "doctor": doctor})
        return
    console.print(summary({**details, **found.to_json()}, doctor, details))
    written = [folder, *([picture] if picture.exists() else []), page]
    print_written(*written, then=f"open {quote(str(page))} in a browser")
