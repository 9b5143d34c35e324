"""Time the functions that are called once in each cycle: a step of each control law, packing and unpacking of each
stream's messages, and one sample of `straightcomp simulate`. Prints the median, least and largest of repeats."""

import argparse
from typing import Any

from rich.table import Table

from straightcomp_ros.bench.step_costs import law_costs, message_costs, simulation_cost
from straightcomp_ros.cli.law_tables import titled_table
from straightcomp_ros.cli.options import check_range
from straightcomp_ros.cli.output import console, print_json, working
from straightcomp_ros.cli.parameter_options import add_parameter_options, chosen_parameters
from straightcomp_ros.parameters.node_parameters import node_parameters

SUMMARY = "µs per control step, per message, and per simulated sample"
_SIMULATIONS = 3
_MOST_REPEATS = 10_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_parameter_options(parser)
    parser.add_argument(
        "--repeats", type=int, default=25, help="repeats of 1000 calls of each function (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Time and print."""
    check_range("--repeats", options.repeats, 1, _MOST_REPEATS)
    values = chosen_parameters(options)
    controller = node_parameters("controller", values)
    with working("timing"):
        sample, speed = simulation_cost(values, min(options.repeats, _SIMULATIONS))
        laws = law_costs(controller.control, controller.stage, options.repeats)
        messages = message_costs(options.repeats)
    figures = {
        "laws": {name: found.to_display() for name, found in laws.items()},
        "messages": {
            topic: {verb: found.to_display() for verb, found in both.items()} for topic, both in messages.items()
        },
        "simulate": {"simulated_seconds_per_second": speed, "sample": sample.to_display()},
    }
    if options.json:
        print_json(figures)
    else:
        console.print(_table(figures))
    return 0


def _table(figures: dict[str, Any]) -> Table:
    table = titled_table("Cost of one call", "part", "median [µs]", "min", "max")
    rows = {f"law '{name}'": found for name, found in figures["laws"].items()}
    for topic, both in figures["messages"].items():
        rows |= {f"{verb} '{topic}'": found for verb, found in both.items()}
    simulate = figures["simulate"]
    rows[f"simulated sample ({simulate['simulated_seconds_per_second']:.1f} × real time)"] = simulate["sample"]
    for part, found in rows.items():
        table.add_row(part, *(f"{found[key]:.2f}" for key in ("median_us", "min_us", "max_us")))
    return table
