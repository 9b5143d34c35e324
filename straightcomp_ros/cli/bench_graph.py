"""Run driver, feedforward, controller and logger as in operation, with the stage moving, and measure them.

Prints the rate, missed periods, lateness of the loop, CPU and memory of each node, and the graph's latency from sample
to command and its losses. The window begins when all nodes are connected and have settled."""

import argparse
from pathlib import Path
from typing import Any

from rich.table import Table

from straightcomp_ros.bench.graph_bench import (
    BenchFailed,
    Measurement,
    bench_parameters,
    measure,
    view_beside,
)
from straightcomp_ros.cell.launcher import RECORDED
from straightcomp_ros.cli.bench_options import add_results, results_folder
from straightcomp_ros.cli.law_tables import rounded, titled_table
from straightcomp_ros.cli.options import check_range
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, require_ros, working
from straightcomp_ros.cli.parameter_options import add_parameter_options, chosen_parameters
from straightcomp_ros.contract import DEFAULT_RATE
from straightcomp_ros.parameters.parameter_sets import ControllerNodeParameters

SUMMARY = "rate, lateness, latency, losses, CPU and memory of the running graph"
_SHORTEST_S, _LONGEST_S = 2.0, 86400.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_parameter_options(parser)
    parser.add_argument("--rate", type=int, default=DEFAULT_RATE, help="samples per second (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the window (default: %(default)s)")
    parser.add_argument(
        "--soak",
        type=float,
        metavar="MINUTES",
        help="use a window of this many minutes, to see whether memory grows; the bag takes about 1 MB/s",
    )
    parser.add_argument(
        "--priority",
        "--fifo",
        type=int,
        default=0,
        metavar="N",
        help="run all nodes at SCHED_FIFO priority N and keep the CPUs awake (default: normal scheduling)",
    )
    parser.add_argument(
        "--triggers",
        action="store_true",
        help="repeat with the controller's other trigger (sample, timer), and print the ratio of both",
    )
    parser.add_argument("--view", action="store_true", help="repeat with the live view open")
    add_results(parser)


def run(options: argparse.Namespace) -> int:
    """Measure and print."""
    require_ros()
    check_range("--seconds", options.seconds, _SHORTEST_S, _LONGEST_S)
    seconds = options.seconds
    if options.soak is not None:
        check_range("--soak", options.soak, _SHORTEST_S / 60.0, _LONGEST_S / 60.0)
        seconds = 60.0 * options.soak
    values = bench_parameters(chosen_parameters(options), rate=options.rate, seconds=seconds, priority=options.priority)
    with results_folder(options) as folder:
        measured = _measured(values, folder / "graph", seconds, "graph")
        figures = measured.to_display()
        if options.soak is not None:
            figures["soak"] = {"minutes": options.soak, "growth_mb_per_hour": dict(measured.growth_mb_per_hour)}
        if options.view:
            beside = view_beside(options.priority)
            figures["with_view"] = _measured(values, folder / "view", seconds, "with view", beside=beside).to_display()
        if options.triggers:
            first = values["controller"].setdefault("trigger", ControllerNodeParameters().trigger)
            second = values["controller"]["trigger"] = _other(first)
            figures |= {"trigger": first, second: _measured(values, folder / second, seconds, second).to_display()}
            figures["ratio"] = ratios(figures, figures[second])
    if options.json:
        print_json(figures)
    else:
        _print(figures, options)
    return 0


def _measured(
    values: dict[str, dict[str, Any]],
    folder: Path,
    seconds: float,
    words: str,
    beside: Any = None,
) -> Measurement:
    if (folder / "bag").exists():
        raise CommandFailed(f"--output: {folder} holds a bag; name another folder", exit_code=2)
    try:
        with working(f"measuring {words}") as advance:
            return measure(values, folder, seconds, progress=advance, beside=beside)
    except BenchFailed as error:
        raise CommandFailed(f"{words}: {error}") from error


def _other(trigger: str) -> str:
    return "timer" if trigger == "sample" else "sample"


def ratios(figures: dict[str, Any], other: dict[str, Any]) -> dict[str, float]:
    """Figures of one measurement divided by those of another: CPU, latency; NaN where the other has zero."""

    def ratio(a: float, b: float) -> float:
        return a / b if b else float("nan")

    return {
        "cpu_cores": ratio(figures["cpu_cores"], other["cpu_cores"]),
        **{
            f"latency_{key}": ratio(figures["latency_us"][key], other["latency_us"][key])
            for key in _LATENCY_WORDS.values()
        },
    }


def _print(figures: dict[str, Any], options: argparse.Namespace) -> None:
    scheduling = f"SCHED_FIFO {options.priority}" if options.priority else "normal scheduling"
    console.print(_table(figures, f"Graph at {options.rate} Hz, {scheduling}, {figures['seconds']:.1f} s; late in µs"))
    _print_whole(figures)
    if "soak" in figures:
        slopes = figures["soak"]["growth_mb_per_hour"]
        console.print("growth of memory [MB/h]: " + ", ".join(f"{node} {slopes[node]:.1f}" for node in RECORDED))
    if "with_view" in figures:
        console.print(_table(figures["with_view"], "With the live view open"))
        _print_whole(figures["with_view"])
    if "trigger" in figures:
        second = _other(figures["trigger"])
        console.print(_table(figures[second], f"With trigger '{second}'"))
        _print_whole(figures[second])
        shown = ", ".join(f"{name} {rounded(value, 2)}" for name, value in figures["ratio"].items())
        console.print(f"{figures['trigger']} / {second}: {shown}")
    if options.output:
        notes.print(f"bags and logs: {options.output}")


def _table(figures: dict[str, Any], title: str) -> Table:
    table = titled_table(title, "node", "Hz", "overruns", "stalls", "p50", "p99", "max", "CPU", "MB")
    for node in RECORDED:
        values = figures[node]
        late = values["timer_error_us"]
        table.add_row(
            node,
            rounded(values["rate_hz"]),
            str(values["overruns"]),
            str(values["stalls"]),
            *(rounded(late[key]) for key in ("p50", "p99", "max")),
            rounded(values["cpu_cores"], 2),
            rounded(values["rss_mb"][-1]),
        )
    return table


def _print_whole(figures: dict[str, Any]) -> None:
    latency, bag = figures["latency_us"], figures["bag"]
    shown = ", ".join(f"{name} {rounded(latency[key])}" for name, key in _LATENCY_WORDS.items())
    missing = ", ".join(f"{topic} {count}" for topic, count in bag["missing"].items() if count) or "nothing"
    console.print(
        f"sample → command [µs]: {shown}\n"
        f"samples without a command: {figures['lost_samples']} of {bag['expected_samples']}; "
        f"missing in the bag: {missing}\n"
        f"CPU: {figures['cpu_cores']:.2f} cores; amplifier on in {100 * bag['amplifier_on']:.1f} % of the window",
        highlight=False,
    )


_LATENCY_WORDS = {"p50": "p50", "p99": "p99", "p99.9": "p999", "max": "max"}
