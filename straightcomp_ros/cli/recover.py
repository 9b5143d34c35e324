"""Make a finished bag from a cut-off or damaged one, and report what was saved and what was lost.

After a SIGKILL or a power failure a bag lacks its index and metadata.yaml; no tool opens it then. This copies all that
is sound into a new bag. The original is never changed."""

import argparse
from pathlib import Path
from shlex import quote
from typing import Any

from straightcomp_ros.cli.options import add_json
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, print_written, working
from straightcomp_ros.cli.results import titled_table

SUMMARY = "make a finished bag from a cut-off or damaged one"
PURPOSE = "judge"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bag", metavar="BAG", help="rosbag2 folder or MCAP file")
    parser.add_argument("--output", "-o", metavar="DIR", help="folder of the new bag (default: BAG_recovered)")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    from straightcomp_ros.bags.recovery import default_output, recover

    bag = Path(options.bag)
    with working("recovering"):
        result = recover(bag, Path(options.output) if options.output else default_output(bag))
    lost = None if result.lost is None else sum(result.lost.values())
    figures = {
        "output": str(result.output),
        "saved": dict(result.saved),
        "saved_messages": result.saved.total(),
        "lost_messages": lost,
        "lost": result.lost,
        "unfinished": result.unfinished,
        "gaps": [dict(zip(("file", "offset", "bytes", "reason"), gap, strict=True)) for gap in result.gaps],
        "not_copied": result.not_copied,
        "duration_s": None if result.time_range is None else (result.time_range[1] - result.time_range[0]) * 1e-9,
    }
    if options.json:
        print_json(figures)
    else:
        _print(result, lost)
    if not result.saved:
        raise CommandFailed(f"bag {bag}: no message could be saved; {result.output} has none")


def _print(result: Any, lost: int | None) -> None:
    topics = sorted({*result.saved, *(result.lost or {})})
    rows = ((topic, result.saved[topic], "?" if lost is None else result.lost.get(topic, 0)) for topic in topics)
    console.print(titled_table(f"Saved to {result.output}", "topic", "saved", "lost", rows=rows))
    print_written(result.output, then=f"straightcomp evaluate {quote(str(result.output))}")
    for name in result.unfinished:
        notes.print(f"{name} was not finished: what was not in it yet when the recording ended is lost")
    for name, offset, length, reason in result.gaps:
        notes.print(f"{name}: {length} bytes at {offset} are lost: {reason}" if length else f"{name}: {reason}")
    for topic in result.not_copied:
        notes.print(f"topic '{topic}' has messages of a further type or encoding: they are not copied")
    if result.whole and result.saved:
        notes.print("nothing was wrong with the bag: the copy has all of it")
    elif lost is not None:
        notes.print(f"messages lost: {lost}")
