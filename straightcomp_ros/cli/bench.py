"""Measure this computer: the running graph, or the functions that are called in each cycle."""

import argparse
import statistics
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from straightcomp_ros.cli import Tool
from straightcomp_ros.cli.options import (
    add_json,
    add_parameter_options,
    add_repeatable,
    chosen_parameters,
    in_range,
    output_folder,
    settings,
)
from straightcomp_ros.cli.output import CommandFailed, console, print_json, print_written, require_ros, working
from straightcomp_ros.cli.results import rounded, titled_table

SUMMARY = "measure the graph's timing, or the cost of its functions"
PURPOSE = "judge"
_SIMULATIONS = 3
_LATENCY_WORDS = {"p50": "p50", "p99": "p99", "p99.9": "p999", "max": "max"}


def _graph_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    add = parser.add_argument
    add("--rate", type=int, metavar="HZ", help="samples per second (default: the stage's)")
    seconds = "length of the window (default: %(default)s); the bag takes about 1 MB/s"
    add("--seconds", type=in_range(float, 2.0, 86400.0), default=20.0, help=seconds)
    priority = "run all nodes at SCHED_FIFO priority N (default: normal scheduling; formerly --fifo)"
    add("--priority", "--fifo", type=int, default=0, metavar="N", help=priority)
    against = "repeat with this parameter, e.g. controller.trigger=timer, and print the ratio of both"
    add_repeatable(parser, "--against", "NODE.NAME=VALUE", against)
    add("--composed", action="store_true", help="repeat with driver, feedforward and controller in one process")
    add("--view", action="store_true", help="repeat with the live view open")
    rounds = "measure all of these in turns, N times, and compare their medians (default: %(default)s)"
    add("--rounds", type=in_range(int, 1), default=1, metavar="N", help=rounds)
    add("--output", "-o", metavar="DIR", help="keep bags and logs here (default: they are removed)")
    add_json(parser)


def _graph(options: argparse.Namespace) -> None:
    """Run driver, feedforward, controller and logger as in operation, with the stage moving, and measure them.

    Prints the rate, missed periods, lateness of the loop, CPU and memory of each node, and the graph's latency from
    sample to command and its losses. The window begins when all nodes are connected and have settled.
    """
    from straightcomp_ros.bench.graph_bench import BenchFailed, bench_parameters, measure, view_programs
    from straightcomp_ros.parameters.node_parameters import STAGE, changed

    require_ros()
    seconds = options.seconds
    given, asked = chosen_parameters(options), {"rate": options.rate, "seconds": seconds, "priority": options.priority}
    values = bench_parameters(given, **asked)
    kinds = {"graph": partial(measure, values)}
    if options.against:
        kinds["against"] = partial(measure, bench_parameters(changed(given, settings(options.against)), **asked))
    if options.composed:
        kinds["composed"] = partial(measure, values, composed=True)
    if options.view:
        kinds["with_view"] = partial(measure, values, programs=view_programs(options.priority))
    rounds: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="straightcomp_bench_") as scratch:
        kept = output_folder("--output", options.output, empty=True) if options.output else Path(scratch)
        for number in range(1, options.rounds + 1):
            measured: dict[str, Any] = {}
            for name, measure_kind in kinds.items():
                place = kept.absolute() / (f"{name}_{number}" if options.rounds > 1 else name)
                try:
                    with working(f"measuring {name}") as advance:
                        measured[name] = measure_kind(folder=place, seconds=seconds, progress=advance)
                except BenchFailed as error:
                    raise CommandFailed(f"{name}: {error}") from error
            rounds.append(measured)
    middle = {name: medians([one[name] for one in rounds]) for name in kinds}
    others = {name: rounds[0][name] for name in kinds if name != "graph"}
    shown = {f"{name}_ratio": ratios(middle[name], middle["graph"]) for name in others}
    figures = {**rounds[0]["graph"], **others, **shown}
    if options.rounds > 1:
        figures["rounds"] = [{name: medians([found]) for name, found in one.items()} for one in rounds]
    if options.json:
        print_json(figures)
    else:
        _print_graph(figures, options, values[STAGE]["rate"])


def medians(measured: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """CPU and latency of several measurements."""
    latency = {key: statistics.median(one["latency_us"][key] for one in measured) for key in _LATENCY_WORDS.values()}
    return {"cpu_cores": statistics.median(one["cpu_cores"] for one in measured), "latency_us": latency}


def ratios(figures: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, float]:
    """Figures of one measurement divided by those of another: CPU, latency; NaN where the other has zero."""

    def ratio(a: float, b: float) -> float:
        return a / b if b else float("nan")

    latency, others = figures["latency_us"], other["latency_us"]
    return {
        "cpu_cores": ratio(figures["cpu_cores"], other["cpu_cores"]),
        **{f"latency_{key}": ratio(latency[key], others[key]) for key in _LATENCY_WORDS.values()},
    }


def _print_graph(figures: Mapping[str, Any], options: argparse.Namespace, rate: int) -> None:
    scheduling = f"SCHED_FIFO {options.priority}" if options.priority else "normal scheduling"
    _print_measurement(figures, f"Graph at {rate} Hz, {scheduling}, {figures['seconds']:.1f} s; late in µs")
    words = {
        "against": f"With {', '.join(options.against)}",
        "composed": "Driver, feedforward and controller in one process",
        "with_view": "With the live view open",
    }
    for name in [name for name in words if name in figures]:
        _print_measurement(figures[name], words[name])
        shown = ", ".join(f"{key} {rounded(value, 2)}" for key, value in figures[f"{name}_ratio"].items())
        console.print(f"{name} / graph: {shown}")
    if "rounds" in figures:
        title = "In turns: latency from sample to command in µs, and CPU in cores"
        table = titled_table(title, "round", "graph", *_LATENCY_WORDS, "CPU", left=("graph",))
        for number, one in enumerate(figures["rounds"], 1):
            for name, found in one.items():
                latency = (rounded(found["latency_us"][key]) for key in _LATENCY_WORDS.values())
                table.add_row(number, name, *latency, rounded(found["cpu_cores"], 2))
        console.print(table)
    if options.output:
        print_written(options.output, then="straightcomp evaluate the bags in it")


def _print_measurement(figures: Mapping[str, Any], title: str) -> None:
    from straightcomp_ros.cell.launcher import RECORDED

    table = titled_table(title, "node", "Hz", "overruns", "stalls", "p50", "p99", "max", "CPU", "MB")
    for node in RECORDED:
        values = figures[node]
        late = (rounded(values["timer_error_us"][key]) for key in ("p50", "p99", "max"))
        missed = (str(values[key]) for key in ("overruns", "stalls"))
        begin, end = values["rss_mb"]
        memory = "–" if end is None else f"{end:.0f} {end - begin:+.0f}"
        table.add_row(node, rounded(values["rate_hz"]), *missed, *late, rounded(values["cpu_cores"], 2), memory)
    console.print(table)
    latency, bag = figures["latency_us"], figures["bag"]
    shown = ", ".join(f"{name} {rounded(latency[key])}" for name, key in _LATENCY_WORDS.items())
    missing = ", ".join(f"{topic} {count}" for topic, count in bag["missing"].items() if count) or "nothing"
    console.print(
        f"sample → command [µs]: {shown}\n"
        f"samples without a command: {figures['lost_samples']} of {bag['expected_samples']}; "
        f"missing in the bag: {missing}\n"
        f"CPU: {figures['cpu_cores']:.2f} cores; amplifier on in {100 * bag['amplifier_on']:.1f} % of the window"
    )


def _step_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    repeats = "repeats of 1000 calls of each function (default: %(default)s)"
    parser.add_argument("--repeats", type=in_range(int, 1, 10_000), default=25, help=repeats)
    add_json(parser)


def _step(options: argparse.Namespace) -> None:
    """Time the functions that are called once in each cycle: a step of each control law, packing and unpacking of each
    stream's messages, and one sample of `straightcomp simulate`. Prints the median, least and largest of repeats."""
    from straightcomp_ros.bench.step_costs import law_costs, message_costs, simulation_cost
    from straightcomp_ros.parameters.node_parameters import node_parameters

    values = chosen_parameters(options)
    controller = node_parameters("controller", values)
    with working("timing"):
        sample, speed = simulation_cost(values, min(options.repeats, _SIMULATIONS))
        laws = law_costs(controller.control, controller.stage, options.repeats)
        messages = message_costs(options.repeats)
    figures = {
        "laws": laws,
        "messages": messages,
        "simulate": {"simulated_seconds_per_second": speed, "sample": sample},
    }
    if options.json:
        print_json(figures)
    else:
        console.print(_costs(figures))


def _costs(figures: Mapping[str, Any]) -> Any:
    table = titled_table("Cost of one call", "function", "median [µs]", "min", "max")
    rows = {f"law '{name}'": found for name, found in figures["laws"].items()}
    for topic, both in figures["messages"].items():
        rows |= {f"{verb} '{topic}'": found for verb, found in both.items()}
    simulate = figures["simulate"]
    rows[f"simulated sample ({simulate['simulated_seconds_per_second']:.1f} × real time)"] = simulate["sample"]
    for function, found in rows.items():
        table.add_row(function, *(f"{found[key]:.2f}" for key in ("median_us", "min_us", "max_us")))
    return table


TOOLS = {
    "graph": Tool("rate, lateness, latency, losses, CPU and memory of the running graph", _graph_arguments, _graph),
    "step": Tool("µs per control step, per message, and per simulated sample", _step_arguments, _step),
}
