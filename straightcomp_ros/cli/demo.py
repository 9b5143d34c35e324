"""Run the real node graph for one stroke forward and back on the simulated stage, record it, and judge the bag.

Starts driver, feedforward, controller, logger and cell as processes, as `ros2 launch straightcomp_ros
cell.launch.py` does. Writes bag/, run.png, logs/ and parameters.yaml to the output folder. The exit
code is 1 for a run that is not in order, and if a node had to be killed. A run that other programs starved of the CPU
ends with 0 where the nodes got no real-time priority, and one whose platform was lost by it is repeated in lockstep,
but not with a board on CAN or a client of OPC UA: with --strict both end with 1. After Ctrl-C what was recorded is in
unfinished/ in the output folder, until the next run."""

import argparse
import dataclasses
import importlib.util
import tempfile
from collections.abc import Mapping
from datetime import datetime
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

from straightcomp_ros.analysis.judgement import STARVED
from straightcomp_ros.analysis.pictures import plot_run
from straightcomp_ros.cell.demonstration import Demonstration, DemonstrationFailed, demonstrate, on_hub, planned
from straightcomp_ros.cell.launcher import isolated_environment
from straightcomp_ros.cli.options import (
    add_force,
    add_json,
    add_namespace,
    add_parameter_options,
    chosen_parameters,
    in_range,
    named_files,
    output_folder,
)
from straightcomp_ros.cli.output import (
    CommandFailed,
    console,
    notes,
    print_json,
    print_written,
    require_ros,
    working,
)
from straightcomp_ros.cli.results import fail_unless_in_order, print_verdict, results_table, timing_table
from straightcomp_ros.parameters.node_parameters import Values, node_parameters
from straightcomp_ros.parameters.output_files import making, remove

SUMMARY = "run the node graph for one stroke, record and evaluate it"
PURPOSE = "run"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    add = parser.add_argument
    add("--output", "-o", metavar="DIR", default="demo_output", help="folder for the results (default: %(default)s)")
    add("--keep", action="store_true", help="keep earlier results: write to a new folder in DIR, named by the time")
    add("--lockstep", action="store_true", help="run in lockstep: deterministic, as fast as the machine can")
    composed = "run driver, feedforward and controller in one process with one loop"
    add("--composed", action="store_true", help=composed)
    hardware = "can: the machine is an emulated board in a process of its own, on a CAN bus between processes"
    add("--hardware", choices=("simulated", "can"), help=hardware)
    opcua = "a client of the OPC UA gateway runs the cycle, in place of the cell's node"
    add("--opcua", action="store_true", help=opcua)
    strict = "exit code 1 also for a run that a busy computer disturbed (verdict starved), and no repeat"
    add("--strict", action="store_true", help=strict)
    add_namespace(parser)
    add("--strokes", type=in_range(int, 1), metavar="N", help="strokes forward and back (default: the parameters')")
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    require_ros()
    if options.opcua and options.lockstep:
        raise CommandFailed("--opcua runs in real time; allowed without --lockstep", exit_code=2)
    if options.opcua and importlib.util.find_spec("asyncua") is None:
        raise CommandFailed("asyncua is not there; remedy: pip install 'straightcomp_ros[opcua]'", exit_code=2)
    values = chosen_parameters(options)
    if options.lockstep:
        _in_lockstep(values)
    if options.strokes is not None:
        values["cell"]["strokes"] = options.strokes
    if options.hardware:
        values["driver"]["hardware"] = options.hardware
    opcua_strokes = values["cell"].get("strokes", 1) if options.opcua else 0
    # What is refused removes no recording of an earlier run.
    node_parameters("driver", values)
    planned(values, opcua_strokes)
    output = output_folder("--output", options.output)
    if options.keep:
        output /= datetime.now().strftime("%Y_%m_%d-%H_%M_%S")
    picture = output / "run.png"
    names = "bag", "bag_incidents", "logs", "parameters.yaml", picture.name
    reads = named_files(options, "--output")
    made = making(output, names, reads=reads, force=options.force)
    environment = isolated_environment()
    domain = environment["ROS_DOMAIN_ID"]
    notes.print(f"ROS domain {domain}; watch it: ROS_DOMAIN_ID={domain} straightcomp view")
    # The path of a socket has room for about a hundred characters: too few for some output folders.
    with made as place, tempfile.TemporaryDirectory() as folder, working("stage moves") as advance:
        if options.hardware == "can":
            values["driver"].update(on_hub(values, str(Path(folder) / "bus")))
        run_it = partial(
            demonstrate,
            values,
            place,
            progress=advance,
            opcua_strokes=opcua_strokes,
            namespace=options.namespace,
            environment=environment,
            composed=options.composed,
        )
        try:
            result = run_it()
        except DemonstrationFailed as error:
            # A board takes its samples whoever waits: it knows no lockstep.
            waits = not options.opcua and values["driver"].get("hardware") != "can"
            if options.strict or options.lockstep or not waits or not error.held_up:
                raise
            # A servo that fails without other programs fails in lockstep too.
            again = "The computer is too busy for real time: once more in lockstep, where the nodes wait for each other"
            text = f"{error}\n{again}"
            notes.print(text, style="yellow")
            remove(place / "bag")
            _in_lockstep(values)
            result = run_it()
        result = dataclasses.replace(result, bag=output / result.bag.name)
        figures = result.figures()
        title = f"Recorded stroke, law '{figures['law']}'"
        plot_run(result.evaluation.record, result.map, result.metrics, place / picture.name, title=title)
    if options.json:
        print_json(figures)
    else:
        console.print(results_table(figures))
        console.print(timing_table(figures["timing"]))
        if result.held_up and not values["driver"].get("lockstep"):  # there each node waits for the others
            console.print(f"Less accurate than it could be: {result.held_up}")
        print_verdict(result.verdict)
        stroke = node_parameters("cell", values).stage.motion.stroke
        console.print(_shown(result, figures, stroke))
        report = f"straightcomp evaluate {quote(str(result.bag))} --report report.html"
        then = f"{report}; docs/tutorial.md goes on from here"
        if result.verdict.verdict == STARVED:
            then = "straightcomp demo --lockstep: the same nodes wait for each other, so that no other program matters"
        print_written(result.bag, picture, then=then)
    # A busy moment of a computer whose user may not ask for priority is no fault of what was installed.
    if options.strict or result.by_priority or result.verdict.verdict != STARVED:
        fail_unless_in_order(result.verdict)
    if result.unclean:
        raise CommandFailed("; ".join(result.unclean))


def _in_lockstep(values: Values) -> None:
    values["driver"]["lockstep"] = True
    values["controller"]["trigger"] = "lockstep"


def _shown(result: Demonstration, figures: Mapping[str, Any], stroke: float) -> str:
    """One sentence for a user who watches: what was to be seen."""
    if result.verdict.verdict == STARVED:
        # Its reason begins with whether the servo works.
        return f"What you saw: {result.verdict.reason.partition(':')[0]}"
    if not result.verdict.in_order:
        return "What you saw: a run that failed; docs/troubleshooting.md says what helps, by the verdict"
    before, after = (figures[name] for name in ("uncompensated_pp_um", "residual_pp_um"))
    return (
        f"What you saw: ROS 2 nodes moved a simulated stage by {stroke:.3g} m on a guide that deviates from a straight "
        f"line by {before:.1f} µm; with the servo on, the platform deviated by {after:.2f} µm"
    )
