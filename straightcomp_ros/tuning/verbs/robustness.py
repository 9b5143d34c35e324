"""Run many strokes on machines that differ from the one that the controller was designed for.

For each trial mass, magnetic force, air gap, friction, the amplifier's bandwidth, sensor noise, command delay, sample
times and the survey are drawn anew within `stage.uncertainty`, and described modes within their own; every law runs on
the very same machines. The controller keeps its description. Trial k of a seed is always the same machine, on any
number of cores, here or on Dask workers. The exit code is 1 if a law is not in order on a machine.
"""

import argparse
import time

from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.cli.options import (
    PICTURES,
    add_dask,
    add_force,
    add_json,
    add_parameter_options,
    add_repeatable,
    chosen_parameters,
    in_range,
    output_file,
)
from straightcomp_ros.cli.output import CommandFailed, console, print_json, print_written, working
from straightcomp_ros.cli.results import (
    doubtful,
    fail_unless_in_order,
    print_verdict,
    titled_table,
    warn_of_missing_margin,
)
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.offline.scenario import make_scenario
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.tuning.sweep.trial import PERCENTILES, LawSummary, plot_sweep, summarise, sweep

SUMMARY = "run many strokes on uncertain machines, offline"
PURPOSE = "tune"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    # Here --law may be repeated: this one takes the place of the one that the other verbs have.
    laws = parser.add_argument_group("laws", conflict_handler="resolve")
    add_repeatable(laws, "--law", None, "control law (default: all)", dest="laws", choices=LAWS)
    parser.set_defaults(law=None)
    add = parser.add_argument
    machines = "uncertain machines (default: %(default)s; formerly --trials)"
    add("--machines", "--trials", dest="trials", type=in_range(int, 1), default=1000, metavar="N", help=machines)
    one = "run only machine K of this seed (formerly --trial); may be repeated"
    kind = in_range(int, 0)
    add("--machine", "--trial", dest="chosen", action="append", default=[], metavar="K", type=kind, help=one)
    add("--seed", type=in_range(int, 0), default=1, metavar="N", help="of all that is drawn (default: 1)")
    add("--jobs", type=in_range(int, 1), metavar="N", help="processes on this machine (default: all cores)")
    add_dask(parser)
    add("--plot", metavar="FILE", help="also save the distribution of the error (PNG, SVG or PDF)")
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    values = chosen_parameters(options)
    laws = list(dict.fromkeys(options.laws or LAWS))
    plot = output_file(options, "--plot", PICTURES)
    started = time.perf_counter()
    scenario = make_scenario(values, laws)
    for control in scenario.controls.values():
        warn_of_missing_margin(control, scenario.description)
    trials = sorted(set(options.chosen)) or range(options.trials)
    machines = f"machine {', '.join(map(str, trials))}" if options.chosen else f"{options.trials} machines"
    with working(machines) as advance:
        try:
            results = sweep(
                scenario, options.seed, trials, jobs=options.jobs or -1, dask=options.dask, progress=advance
            )
        except SurveyError as error:
            # The given survey is good: one with random errors is not.
            raise CommandFailed(str(error)) from error
    seconds = time.perf_counter() - started
    summaries = summarise(results)
    if plot is not None:
        plot_sweep(summaries, plot, f"{machines}, seed {options.seed}")
    verdict = _verdict(summaries)
    if options.json:
        shown = {summary.law: summary.to_display() for summary in summaries}
        run_of = {"trials": len(trials), "seed": options.seed, "laws": shown, "seconds": seconds}
        print_json({**run_of, **verdict._asdict()})
    else:
        title = f"True compensation error p-p in µm on {machines}, seed {options.seed}"
        columns = ("law", *PERCENTILES, "worst machine", "RMS Δi_c [mA]", "not in order")
        table = titled_table(title, *columns, rows=map(_row, summaries))
        console.print(table)
        for summary in summaries:
            print_verdict(summary.verdict, summary.law)
        console.print(f"{seconds:.0f} s; the machines are those of stage.uncertainty; --machine K runs one alone.")
        if plot is not None:
            print_written(plot, then="run one machine alone with --machine K")
    fail_unless_in_order(verdict)


def _row(summary: LawSummary) -> list[object]:
    texts = {name: with_digits(value * 1e6, 3) for name, value in summary.percentiles("pp").items()}
    pp = [doubtful(text) if name in summary.doubtful else text for name, text in texts.items()]
    step = with_digits(summary.percentiles("control_rms_step")["p50"] * 1e3, 1)
    return [summary.law, *pp, summary.worst.trial, step, len(summary.not_in_order)]


def _verdict(summaries: list[LawSummary]) -> Verdict:
    """That on the first law with a machine that is not in order, or on all."""
    for summary in summaries:
        if not summary.verdict.in_order:
            return Verdict(summary.verdict.verdict, f"law '{summary.law}': {summary.verdict.reason}")
    return summaries[0].verdict
