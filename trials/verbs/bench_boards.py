"""Run strokes through boards with several kinds of frames, in turns, and compare them: error, losses, latency.

Each board is emulated, on a hub of this computer, in real time, with the same law. With --firmware the firmware core is
built with the frames of each and runs them too."""

import argparse
from pathlib import Path

from straightcomp_ros.cli.options import add_repeatable, add_results, add_setting_option
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, require_ros
from straightcomp_ros.cli.results import rounded, titled_table
from straightcomp_ros.parameters.share import share_path
from trials.verbs.rounds import add_rounds, rounds

SUMMARY = "strokes through boards with other frames, and through the firmware core"
_FOREIGN = "config/board_motorola.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_repeatable(parser, "--board", "FILE", f"stage file with a board's frames (default: the installed {_FOREIGN})")
    parser.add_argument("--firmware", metavar="DIR", type=Path, help="folder firmware/ of the source")
    add_rounds(parser)
    add_setting_option(parser)
    add_results(parser)


def run(options: argparse.Namespace) -> int:
    """Measure and print; exit code 1 if a stroke was not in order."""
    from trials.bench.boards import boards, measure

    require_ros()
    if options.firmware is not None and not (options.firmware / "Makefile").is_file():
        raise CommandFailed(f"--firmware '{options.firmware}': has no Makefile; allowed: firmware/ of the source", 2)
    stages = [None, *(options.board or [str(share_path(_FOREIGN))])]
    changes = [word for change in options.set for word in ("--set", change)]
    with rounds(options) as (folder, progress):
        figures = measure(boards(stages, options.firmware, folder), options.rounds, changes, folder, progress)
    if options.json:
        print_json(figures)
    else:
        title = f"Medians of {options.rounds}: p-p in µm, lost samples + commands, sample to command in µs"
        columns = ("p-p", "range", "lost", "p50", "p99", "failed")
        table = titled_table(title, "frames, board", *columns)
        for one in figures["boards"]:
            least, largest = (rounded(end(one["pp_um_of_each"], default=None), 2) for end in (min, max))
            table.add_row(
                f"{one['frames']}, {one['board']}",
                rounded(one["pp_um"], 2),
                f"{least}–{largest}",
                f"{one['lost_samples']}+{one['lost_commands']}",
                rounded(one["latency_p50_us"]),
                rounded(one["latency_p99_us"]),
                str(len(one["failed"])),
            )
        console.print(table)
        for reason in (reason for one in figures["boards"] for reason in (*one["failed"], *one["not_in_order"])):
            notes.print(reason, soft_wrap=True)
    return 0 if figures["in_order"] else 1
