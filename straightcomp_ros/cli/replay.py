"""Run a recorded run again.

Without options an audit: every command is computed again from the recorded samples and references, and must come out
the same to the last bit. With --law or --set, what would have been: the loop is simulated on the recorded motion and
map; the exit code is 1 unless that run is in order. With --graph the real nodes get the recorded samples, without a
driver, and a new bag records what they answer."""

import argparse
import dataclasses
from pathlib import Path
from shlex import quote
from typing import Any

from straightcomp_ros.analysis.figure_words import in_words
from straightcomp_ros.cli.evaluate import add_remap_option, parsed_remap
from straightcomp_ros.cli.options import add_force, add_json, add_repeatable, output_folder
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, print_written, require_ros, working
from straightcomp_ros.cli.results import fail_unless_in_order, marked, print_verdict, shown, titled_table

SUMMARY = "run a recorded run again: to the bit, or with other laws and parameters"
PURPOSE = "judge"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("bag", metavar="BAG", help="rosbag2 folder or MCAP file, finished or not")
    add("--law", help="what if this law had run")
    changed = "what if this parameter had been so, e.g. controller.control.smc_observer.bandwidth=300"
    add_repeatable(parser, "--set", "NODE.NAME=VALUE", changed)
    add("--params-file", metavar="FILE", help="ROS 2 parameter file of the run, for a bag without parameters")
    add("--graph", action="store_true", help="play the samples to feedforward, controller and logger")
    add("--output", "-o", metavar="DIR", default="replay_output", help="folder for --graph (default: %(default)s)")
    add_remap_option(parser)
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    changes = bool(options.law or options.set)
    if options.graph and changes:
        raise CommandFailed("allowed: either --graph, or --law and --set", exit_code=2)
    action = _graph if options.graph else _what_if if changes else _audit
    action(options, Path(options.bag), parsed_remap(options.remap), _given(options))


def _given(options: argparse.Namespace) -> dict[str, dict[str, Any]] | None:
    from straightcomp_ros.parameters.node_parameters import by_node
    from straightcomp_ros.parameters.parameter_file import shipped_parameters

    return by_node(shipped_parameters(options.params_file)) if options.params_file else None


def _audit(options: argparse.Namespace, bag: Path, remap: dict[str, str], given: Any) -> None:
    from straightcomp_ros.offline.audit import audit

    with working("computing the commands again"):
        found = audit(bag, remap, given)
    if options.json:
        print_json(dataclasses.asdict(found))
    else:
        counts = f"{found.different} different, {found.unverified} not verifiable"
        console.print(f"law '{found.law}': {found.commands} commands computed again, {counts}")
    if found.missing:
        missing = f"{found.missing} samples, references or states are not in the bag"
        notes.print(f"{missing}: commands after them cannot be computed until the law starts anew")
    if found.changed:
        notes.print("the controller's parameters changed while it was recorded: what came then is not verified")
    if found.began_running:
        notes.print("the recording began while the law was running: it is verified from the law's next start")
    if found.first:
        first = found.first
        raise CommandFailed(
            f"bag {bag}: the first difference is in step {first.step} (stamp {first.stamp_ns} ns), {first.column}: "
            f"recorded {first.recorded!r} ({first.recorded.hex()}), "
            f"computed {first.computed!r} ({first.computed.hex()})"
        )
    if not found.passed:
        raise CommandFailed(f"bag {bag}: no command can be verified")


def _what_if(options: argparse.Namespace, bag: Path, remap: dict[str, str], given: Any) -> None:
    from straightcomp_ros.cli.options import chosen_changes
    from straightcomp_ros.offline.what_if import what_if

    with working("simulating"):
        runs = what_if(bag, chosen_changes(options), remap, given)
    columns = [run.to_display() for run in runs]
    verdict = runs[-1].verdict
    if options.json:
        names = ("recorded", "simulated_as_recorded", "what_if")
        found = {name: {"law": run.law, **one} for name, run, one in zip(names, runs, columns, strict=False)}
        print_json({**found, **verdict._asdict()})
    else:
        words = ("recorded", "simulated\nas recorded", "what if")
        headings = [f"{word}\n{run.law}" for word, run in zip(words, runs, strict=False)]
        names = runs[0].metrics.to_display()
        table = titled_table(f"What if: {bag}", "figure", *headings, "unit", left=("unit",))
        for name in names:
            what, unit = in_words(name)
            table.add_row(what, *(marked(name, shown(one[name]), one) for one in columns), unit)
        console.print(table)
        for word, run in zip(words, runs, strict=False):
            print_verdict(run.verdict, f"'{' '.join(word.split())}'")
    fail_unless_in_order(verdict)


def _graph(options: argparse.Namespace, bag: Path, remap: dict[str, str], given: Any) -> None:
    from straightcomp_ros.cell.launcher import LaunchError
    from straightcomp_ros.offline.graph_replay import replay_through_graph
    from straightcomp_ros.parameters.output_files import making

    require_ros()
    output = output_folder("--output", options.output)
    try:
        made = making(output, ("bag", "logs"), reads=[bag], force=options.force)
        with made as place, working("playing to the graph"):
            found = replay_through_graph(bag, place, remap, given)
    except LaunchError as error:
        raise CommandFailed(f"{error} (logs in {place}/logs)") from error
    found = dataclasses.replace(found, bag=output / found.bag.name)
    if options.json:
        print_json({**vars(found), "bag": str(found.bag)})
    else:
        counts = f"{found.equal} as recorded to the bit, {found.different} otherwise"
        played = f"{found.samples} samples played; {found.commands} commands came back"
        console.print(f"{played}: {counts}")
        print_written(found.bag, then=f"straightcomp replay {quote(str(found.bag))}")
