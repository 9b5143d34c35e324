"""Inject every fault into the running graph, measure how soon it is latched, and tell whether that is soon enough.

Starts driver, feedforward, controller and logger on the simulated machine, and injects each fault with the stage moving
and the amplifier on. Exit code 0 if every row is green."""

import argparse
import shutil
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.table import Table

from straightcomp_ros.cell.launcher import LaunchError
from straightcomp_ros.cli.options import add_parameter_options, check_range, chosen_parameters, output_folder
from straightcomp_ros.cli.output import CommandFailed, console, print_json, progress_bar, require_ros, styled
from straightcomp_ros.cli.results import rounded
from trials.faults.rows import summary

SUMMARY = "inject every fault in the running graph and measure its detection"
_REPEATS, _QUICK = 20, 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_parameter_options(parser)
    parser.add_argument(
        "--kills",
        type=int,
        default=0,
        metavar="N",
        help="instead: run N cycles of the cell, kill a "
        "node at a random time in each, and print what cell, evaluate and history say",
    )
    parser.add_argument("--quick", action="store_true", help=f"{_QUICK} injections of each instead of {_REPEATS}")
    parser.add_argument("--only", metavar="TEXT", default="", help="inject only faults with this text in their name")
    parser.add_argument("--output", "-o", metavar="FOLDER", help="keep bags and logs in this folder")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Measure and print."""
    require_ros()
    from trials.faults.injections import TRIALS, run_trials, trial_parameters

    check_range("--kills", options.kills, 0, 10_000)
    if options.kills:
        return _run_kills(options)
    chosen = [trial for trial in TRIALS if options.only in trial.name]
    if not chosen:
        names = ", ".join(trial.name for trial in TRIALS)
        raise CommandFailed(f"--only {options.only!r}: no fault has this in its name; known: {names}", exit_code=2)
    values = trial_parameters(chosen_parameters(options))
    begin = time.monotonic()
    if options.output:
        folder = output_folder("--output", options.output, empty=True)
    else:
        folder = Path(tempfile.mkdtemp(prefix="straightcomp_faults_"))
    with ExitStack() as end, progress_bar() as bar:
        if not options.output:
            end.callback(shutil.rmtree, folder, ignore_errors=True)
        task = bar.add_task("starting", total=1.0)
        try:
            rows = run_trials(
                values,
                folder,
                _QUICK if options.quick else _REPEATS,
                lambda name, done: bar.update(task, description=name, completed=done),
                chosen,
            )
        except LaunchError:
            # The message names the folder of the logs, so keep it.
            end.pop_all()
            raise
    figures = summary(rows, time.monotonic() - begin)
    if options.json:
        print_json(figures)
    else:
        console.print(_table(figures))
        for row in figures["faults"]:
            for failure in row["failures"]:
                console.print(f"{row['name']}: {failure}")
    return 0 if figures["all_green"] else 1


def _run_kills(options: argparse.Namespace) -> int:
    from trials.faults.kills import run_kills

    if options.output:
        folder = output_folder("--output", options.output, empty=True)
    else:
        folder = Path(tempfile.mkdtemp(prefix="straightcomp_kills_"))
    with progress_bar() as bar:
        task = bar.add_task("starting", total=1.0)
        kills = run_kills(
            chosen_parameters(options),
            folder,
            options.kills,
            lambda name, done: bar.update(task, description=name, completed=done),
        )
    if options.json:
        print_json({"kills": [{**kill._asdict(), "named": kill.named, "judged": kill.judged} for kill in kills]})
    else:
        for kill in kills:
            words = f"{kill.node} killed {kill.at:.1f} s after the start: cell ended with {kill.exit_code}: {kill.cell}"
            console.print(f"{words}\n  bag {kill.bag}\n  evaluate {kill.evaluate}\n  history {kill.history}")
        named, judged = sum(kill.named for kill in kills), sum(kill.judged for kill in kills)
        console.print(f"of {len(kills)} kills the cell named {named}; {judged} bags are not in order")
    return 0 if all(kill.named and kill.judged for kill in kills) else 1


def _table(figures: dict[str, Any]) -> Table:
    table = Table(title=f"Faults in the running graph; {figures['seconds']:.0f} s", title_justify="left")
    table.add_column("fault")
    for column in ("injected", "detected", "median [ms]", "max [ms]", "limit [ms]"):
        table.add_column(column, justify="right")
    table.add_column("")
    for row in figures["faults"]:
        table.add_row(
            row["name"],
            str(row["injected"]),
            str(row["detected"]),
            *(rounded(row[key], 3) for key in ("median_ms", "max_ms", "limit_ms")),
            styled(("ok", "green") if row["green"] else ("RED", "red")),
        )
    return table
