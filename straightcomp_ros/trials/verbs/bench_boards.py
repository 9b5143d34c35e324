"""Run strokes through boards with several kinds of frames, in turns, and compare them: error, losses, latency.

Each board is emulated, on a hub of this computer, in real time, with the same law. With --firmware the firmware core is
built with the frames of each and runs them too."""

import argparse
import tempfile
from contextlib import ExitStack
from pathlib import Path

from straightcomp_ros.analysis.judgement import IN_ORDER
from straightcomp_ros.cli.law_tables import rounded, titled_table
from straightcomp_ros.cli.options import add_repeatable, check_range, output_folder
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, progress_bar, require_ros
from straightcomp_ros.cli.parameter_options import add_setting_option
from straightcomp_ros.settings.share import share_path

SUMMARY = "strokes through boards with other frames, and through the firmware core"
_FOREIGN = "config/board_motorola.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_repeatable(parser, "--board", "FILE", f"stage file with a board's frames (default: the installed {_FOREIGN})")
    parser.add_argument("--firmware", metavar="DIR", type=Path, help="folder firmware/ of the source")
    parser.add_argument("--rounds", type=int, default=1, metavar="N", help="strokes of each (default: %(default)s)")
    add_setting_option(parser)
    parser.add_argument("--output", "-o", metavar="DIR", help="keep bags and logs here (default: they are removed)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Measure and print; exit code 1 if a stroke was not in order."""
    from straightcomp_ros.trials.bench.boards import boards, measure
    from straightcomp_ros.trials.bench.demo_strokes import BenchFailed

    require_ros()
    check_range("--rounds", options.rounds, 1, 1000)
    if options.firmware is not None and not (options.firmware / "Makefile").is_file():
        raise CommandFailed(f"--firmware '{options.firmware}': has no Makefile; allowed: firmware/ of the source", 2)
    stages = [None, *(options.board or [str(share_path(_FOREIGN))])]
    changes = [word for change in options.set for word in ("--set", change)]
    with ExitStack() as stack:
        folder = (
            output_folder("--output", options.output)
            if options.output
            else Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="straightcomp_bench_")))
        )
        bar = stack.enter_context(progress_bar())
        task = bar.add_task("building", total=1.0)
        try:
            figures = measure(
                boards(stages, options.firmware, folder.absolute()),
                options.rounds,
                changes,
                folder,
                progress=lambda text, done: bar.update(task, description=text, completed=done),
            )
        except BenchFailed as error:
            raise CommandFailed(str(error)) from error
    if options.json:
        print_json(figures)
    else:
        title = f"Medians of {options.rounds}: p-p in µm, lost samples + commands, sample to command in µs"
        columns = ("p-p", "range", "lost", "p50", "p99", "failed")
        table = titled_table(title, "frames, board", *columns)
        for one in figures["boards"]:
            least, largest = (rounded(end(one["pp_um_of_each"]), 2) for end in (min, max))
            table.add_row(
                f"{one['frames']}, {one['board']}",
                rounded(one["pp_um"], 2),
                f"{least}–{largest}",
                f"{one['lost_samples']}+{one['lost_commands']}",
                rounded(one["latency_p50_us"]),
                rounded(one["latency_p99_us"]),
                str(len(one["failed"])),
            )
            if one["verdict"] != IN_ORDER:
                notes.print(f"{one['frames']}, {one['board']}: {one['verdict'].replace('_', ' ')}")
        console.print(table)
        for reason in (reason for one in figures["boards"] for reason in one["failed"]):
            notes.print(reason)
    return 0 if figures["in_order"] else 1
