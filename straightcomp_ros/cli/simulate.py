"""Run one cycle of the stage offline: the same plant, map and control law as the running graph, deterministic."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path

from straightcomp_ros.analysis.metrics import MetricsError, evaluate
from straightcomp_ros.analysis.plot import plot_run
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.cli.output import CommandFailed, console, print_json, progress_bar
from straightcomp_ros.cli.parameters import add_parameter_options, chosen_parameters
from straightcomp_ros.cli.tables import results_table
from straightcomp_ros.parameters import ParameterError
from straightcomp_ros.simulation import Simulation
from straightcomp_ros.straightness.survey import SurveyError

SUMMARY = "run a stroke forward and back offline"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_parameter_options(parser)
    parser.add_argument(
        "--delay", type=float, metavar="SAMPLES", help="command delay in sampling periods (default: 0.5)"
    )
    parser.add_argument("--bag", metavar="DIR", help="also write the run as a bag, as the graph would record it")
    parser.add_argument("--plot", metavar="FILE", help="also save a plot (PNG)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Simulate and print the figures."""
    values = chosen_parameters(options)
    if options.delay is not None:
        values["driver"]["lockstep_delay"] = options.delay
    try:
        simulation = Simulation(values)
    except (ParameterError, SurveyError) as error:
        raise CommandFailed(str(error), exit_code=2) from error
    try:
        with ExitStack() as stack:
            bar = stack.enter_context(progress_bar())
            task = bar.add_task("simulating", total=1.0)
            bag = (
                stack.enter_context(SimulatedRun(Path(options.bag), values, simulation.delay)) if options.bag else None
            )
            record = simulation.run(lambda fraction: bar.update(task, completed=fraction), bag.add if bag else None)
    except BagError as error:
        raise CommandFailed(str(error)) from error
    try:
        metrics = evaluate(record, simulation.map)
    except MetricsError as error:
        raise CommandFailed(str(error)) from error
    if options.plot:
        plot_run(record, simulation.map, metrics, Path(options.plot), title=f"Simulated stroke, law '{record.law}'")
    figures = {"law": record.law, "delay_samples": simulation.delay, **metrics.to_display()}
    if options.json:
        print_json(figures)
    else:
        console.print(results_table(figures))
    return 0
