"""Run many strokes on machines that differ from the one that the controller was designed for.

For each trial mass, magnetic force, air gap, friction, sensor noise, command delay, sample times and the survey are
drawn anew, and every law runs on the very same machines. The controller keeps its nominal design. Trial k of a seed
is always the same machine, on any number of cores, here or on Dask workers.
"""

from __future__ import annotations

import argparse
import re
import time
from typing import Any

from rich.table import Table

from straightcomp_ros.analysis.record import MetricsError
from straightcomp_ros.cli.law_tables import titled_table
from straightcomp_ros.cli.output import PICTURES, CommandFailed, console, output_file, print_json, progress_bar
from straightcomp_ros.cli.parameter_options import add_parameter_options, chosen_parameters
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.offline.sweep.many_trials import PERCENTILES, LawSummary, SweepError, summarise, sweep
from straightcomp_ros.offline.sweep.scenario import make_scenario
from straightcomp_ros.offline.sweep.sweep_plot import plot_sweep
from straightcomp_ros.offline.sweep.uncertainty import UncertaintyParameters
from straightcomp_ros.settings.declaration import ParameterError, declarations, from_mapping
from straightcomp_ros.straightness.survey import SurveyError

SUMMARY = "run many strokes on uncertain machines, offline"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_parameter_options(parser)
    # Here --law may be repeated: this one takes the place of the one that the other verbs have.
    laws = parser.add_argument_group("laws", conflict_handler="resolve")
    laws.add_argument(
        "--law", dest="laws", action="append", choices=LAWS, help="control law; may be repeated (default: all)"
    )
    parser.set_defaults(law=None)
    parser.add_argument("--trials", type=_count, default=1000, metavar="N", help="machines (default: %(default)s)")
    parser.add_argument("--seed", type=_natural, default=1, metavar="N", help="of all that is drawn (default: 1)")
    parser.add_argument(
        "--range",
        dest="ranges",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="change one range, e.g. mass=0.3; may be repeated; names: "
        + ", ".join(declaration.name for declaration in declarations(UncertaintyParameters)),
    )
    parser.add_argument("--jobs", type=_count, metavar="N", help="processes on this machine (default: all cores)")
    parser.add_argument("--dask", default="", metavar="ADDRESS", help="run on the workers of this Dask scheduler")
    parser.add_argument("--plot", metavar="FILE", help="also save the distribution of the error (PNG, SVG or PDF)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def run(options: argparse.Namespace) -> int:
    """Sweep and print the figures."""
    values = chosen_parameters(options)
    laws = list(dict.fromkeys(options.laws or LAWS))
    plot = output_file("--plot", options.plot, PICTURES) if options.plot else None
    if options.dask and not re.fullmatch(r".*:\d+", options.dask):
        # Dask itself takes 40 s to be sure.
        raise CommandFailed(f"--dask {options.dask}; allowed: HOST:PORT or tcp://HOST:PORT", exit_code=2)
    started = time.perf_counter()
    try:
        ranges = from_mapping(UncertaintyParameters, dict(map(_assignment, options.ranges)))
        scenario = make_scenario(values, laws, ranges)
    except (ParameterError, SurveyError) as error:
        raise CommandFailed(str(error), exit_code=2) from error
    with progress_bar() as bar:
        task = bar.add_task(f"{options.trials} machines", total=1.0)
        try:
            results = sweep(
                scenario,
                options.seed,
                options.trials,
                jobs=options.jobs or -1,
                dask=options.dask,
                progress=lambda fraction: bar.update(task, completed=fraction),
            )
        except (SweepError, SurveyError, MetricsError) as error:
            raise CommandFailed(str(error)) from error
    seconds = time.perf_counter() - started
    summaries = summarise(results)
    if plot is not None:
        plot_sweep(results, summaries, plot, f"{options.trials} machines, seed {options.seed}")
    if options.json:
        print_json(
            {
                "trials": options.trials,
                "seed": options.seed,
                "laws": {summary.law: summary.to_display() for summary in summaries},
                "seconds": seconds,
            }
        )
    else:
        console.print(_table(summaries, ranges, options, seconds))
    return 0


def _table(
    summaries: list[LawSummary], ranges: UncertaintyParameters, options: argparse.Namespace, seconds: float
) -> Table:
    title = f"True compensation error p-p in µm on {options.trials} machines, seed {options.seed}"
    table = titled_table(title, "law", *PERCENTILES, "failures", "limit cycles")
    table.caption, table.caption_justify = f"{_conditions(ranges)}\n{seconds:.0f} s", "left"
    for summary in summaries:
        table.add_row(
            summary.law,
            *(f"{value * 1e6:.3f}" for value in summary.pp.values()),
            str(sum(summary.failures.values())),
            str(summary.limit_cycles),
        )
    return table


def _conditions(ranges: UncertaintyParameters) -> str:
    return (
        f"mass ±{ranges.mass:.0%}, magnetic force ±{ranges.force:.0%}, air gap ±{ranges.air_gap:.0%}, "
        f"friction × or ÷ {ranges.friction:g}, sensor noise to {ranges.sensor_noise * 1e6:g} µm RMS, "
        f"delay {ranges.shortest_delay:g} to {ranges.longest_delay:g} samples, jitter ±{ranges.jitter * 1e6:g} µs, "
        f"survey error {ranges.map_noise * 1e6:g} µm RMS"
    )


def _assignment(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals:
        raise ParameterError(f"--range {text!r}: allowed: NAME=VALUE")
    try:
        return name, float(value)
    except ValueError:
        # Refused where the name is known, with the range that is allowed.
        return name, value


def _natural(text: str) -> int:
    if not text.isascii() or not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r}; allowed: a whole number >= 0")
    return int(text)


def _count(text: str) -> int:
    if (number := _natural(text)) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}; allowed: a whole number >= 1")
    return number
