"""Run the graph for a long time with random actions on it, and tell whether it recovered from each.

Starts driver, feedforward, controller and logger on the simulated machine with the stage moving. The actions:
amplifier, maps, laws, refused parameters, recorder, lifecycle, SIGSTOP, SIGKILL and restart. After each action the
safety state and the work of the whole graph are checked; at the end bags, strokes, descriptors, threads and memory.
Exit code 0 only if nothing failed."""

import argparse
import tempfile
from pathlib import Path
from typing import Any

from rich.table import Table

from straightcomp_ros.cli.options import add_parameter_options, chosen_parameters, output_folder
from straightcomp_ros.cli.output import CommandFailed, console, print_json, progress_bar, require_ros
from straightcomp_ros.cli.results import rounded, titled_table

SUMMARY = "run the graph for a long time under random actions and check it after each"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_parameter_options(parser)
    parser.add_argument("--minutes", type=float, default=30.0, help="duration of the actions in minutes (default: 30)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the random choices (default: 1)")
    parser.add_argument(
        "--output",
        "-o",
        metavar="FOLDER",
        help="keep bags, logs and the list of actions in this new or empty folder",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Run and print."""
    require_ros()
    if not 0.0 < options.minutes <= 7 * 24 * 60:
        raise CommandFailed(f"--minutes {options.minutes:g}: allowed: above 0, up to a week", exit_code=2)
    if options.output:
        output_folder("--output", options.output, empty=True)
    from trials.faults.injections import trial_parameters
    from trials.soak.long_run import run_soak

    values = trial_parameters(chosen_parameters(options))
    with tempfile.TemporaryDirectory() as folder, progress_bar() as bar:
        task = bar.add_task("starting", total=1.0)
        result = run_soak(
            values,
            Path(options.output or folder),
            60.0 * options.minutes,
            options.seed,
            lambda kind, done: bar.update(task, description=kind, completed=done),
        )
    figures = result.to_display()
    if options.json:
        print_json(figures)
    else:
        _print(figures)
    return 0 if figures["passed"] else 1


def _print(figures: dict[str, Any]) -> None:
    console.print(_actions(figures))
    console.print(_processes(figures))
    strokes, bags = figures["strokes"], figures["bags"]
    facts = [
        f"strokes commanded while recorded: {strokes['commanded']}, found in the bags: {strokes['found']}",
        f"bags: {bags.get('finished', 0)} finished, {bags.get('recovered', 0)} recovered after a SIGKILL",
        "faults latched as they must or may: "
        + (", ".join(f"{count} {name}" for name, count in figures["faults"].items()) or "none"),
        "faults while this machine stood still: "
        + (", ".join(f"{count} {name}" for name, count in figures["faults_in_stalls"].items()) or "none"),
        f"answers of services that did not come within 3 s: {figures['answers_lost']}",
        f"longest from enable to on: {rounded(figures['longest_enable_s'], 2)} s; "
        f"from an action to the whole graph at work: {rounded(figures['longest_back_to_work_s'], 1)} s",
        *figures["failures"],
    ]
    for fact in facts:
        console.print(fact)
    console.print("passed" if figures["passed"] else f"{len(figures['failures'])} failures")


def _actions(figures: dict[str, Any]) -> Table:
    table = titled_table(f"Soak, seed {figures['seed']}; {figures['seconds']:.0f} s", "action", "done", "failed")
    for kind, counts in figures["actions"].items():
        table.add_row(kind, str(counts["done"]), str(counts["failed"]))
    return table


def _processes(figures: dict[str, Any]) -> Table:
    columns = ("seen for [s]", "descriptors", "threads", "memory [MB]", "slope [MB/h]")
    table = titled_table("Processes, from their warm-up to their end", "node", *columns)
    table.add_column("end")
    for life in figures["processes"]:
        table.add_row(
            life["name"],
            rounded(life["seconds"]),
            "{} → {}".format(*life["descriptors"]),
            "{} → {}".format(*life["threads"]),
            "{:.1f} → {:.1f}".format(*life["rss_mb"]),
            rounded(life["slope_mb_per_hour"]),
            "survived" if life["survived"] else "killed",
        )
    return table
