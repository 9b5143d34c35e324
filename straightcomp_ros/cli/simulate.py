"""Run cycles of the stage offline: the same plant, map and control law as the running graph, deterministic."""

import argparse
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from shlex import quote

from straightcomp_ros.analysis.judgement import Verdict, worst
from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.cli.options import (
    PICTURES,
    add_force,
    add_json,
    add_parameter_options,
    chosen_parameters,
    in_range,
    output_file,
)
from straightcomp_ros.cli.output import CommandFailed, console, print_json, print_written, working
from straightcomp_ros.cli.results import (
    cycles_table,
    fail_unless_in_order,
    print_verdict,
    results_table,
    warn_of_missing_margin,
)
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import Run, Spread, can_run, run_stroke, runs_of_starts, simulated_run, spreads
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import Values, by_node, node_parameters
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.survey_header import SurveyError

SUMMARY = "run strokes forward and back offline"
PURPOSE = "run"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_parameter_options(parser)
    add = parser.add_argument
    add("--delay", type=float, metavar="SAMPLES", help="command delay in sampling periods (default: the stage's)")
    add("--strokes", type=in_range(int, 1), default=1, metavar="N", help="cycles forward and back (default: 1)")
    starts = "repeat the cycle from N places of the platform around its start, and print median and range (default: 1)"
    add("--starts", type=in_range(int, 1), default=1, metavar="N", help=starts)
    add("--learn", action="store_true", help="learn from stroke to stroke")
    learned = "as --learn; read what was learned from FILE if it exists, and write it there"
    add("--learned", metavar="FILE", help=learned)
    add("--bag", metavar="DIR", help="also write the run as a bag, as the graph would record it")
    add("--plot", metavar="FILE", help="also save a plot (PNG, SVG or PDF)")
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    values = chosen_parameters(options)
    if options.delay is not None:
        values["stage"]["drive.delay"] = options.delay
    if options.starts > 1 and (options.strokes > 1 or options.learn or options.learned or options.bag):
        excluded = "--strokes, --learn, --learned and --bag"
        raise CommandFailed(f"--starts: is of single cycles; leave out {excluded}", exit_code=2)
    plot = output_file(options, "--plot", PICTURES)
    if options.learn or options.learned:
        values["controller"]["learning.learn"] = True
    if options.learned:
        values["controller"]["learning.file"] = str(output_file(options, "--learned", updates=options.learned))
    over_starts: dict[str, Spread] = {}
    try:
        record, straightness, cycles = _run_cycles(options, values)
        verdict = _worst(cycles, "cycle")
        if verdict.in_order:
            # The figures are the last cycle's.
            verdict = cycles[-1].verdict
        if options.starts > 1:
            with working("simulating the starts") as advance:
                runs = runs_of_starts(values, options.starts, advance)
                found = [simulated_run(*one, values) for one in runs]
            over_starts = spreads(one.metrics.to_display() for one in found)
            verdict = _worst(found, "start")
    except (BagError, ParameterError, SurveyError):
        raise
    except ValueError as error:
        # Among others: the position or the current became infinite.
        raise CommandFailed(str(error)) from error
    if plot is not None:
        # Only here: matplotlib takes longer to import than the cycle to run.
        from straightcomp_ros.analysis.pictures import plot_run

        plot_run(record, straightness, cycles[-1].metrics, plot, title=f"Simulated stroke, law '{record.law}'")
    shown = [cycle.to_display() for cycle in cycles]
    controller = node_parameters("controller", values)
    missing = warn_of_missing_margin(controller.control, controller.stage)
    delay = node_parameters("driver", values).stage.drive.delay
    figures = {"law": record.law, "delay_samples": delay, **shown[-1], **verdict._asdict(), "missing_margin": missing}
    if options.json:
        if over_starts:
            figures["starts"] = {"count": options.starts, **{k: one._asdict() for k, one in over_starts.items()}}
        names = ("true_pp_um", "true_rms_um", "verdict", "reason")
        listed = [{name: one[name] for name in names} for one in shown]
        print_json({**figures, "cycles": listed} if options.strokes > 1 else figures)
    else:
        if options.strokes > 1:
            console.print(cycles_table(figures["law"], shown))
        console.print(results_table(figures, over_starts))
        print_verdict(verdict)
        written = [one for one in (options.bag, options.learned, plot) if one]
        stage = f" --stage {quote(options.stage)}" if options.stage else ""
        nodes = f"straightcomp demo{stage} runs the same as nodes"
        then = f"straightcomp evaluate {quote(options.bag)}" if options.bag else nodes
        if written:
            print_written(*written, then=then)
    fail_unless_in_order(verdict)


def _run_cycles(options: argparse.Namespace, values: Values) -> tuple[StrokeRecord, StraightnessMap, list[Run]]:
    """The last cycle, the map, and the figures and verdicts of all cycles."""
    if options.strokes == 1 and not options.bag and can_run(values):
        record, straightness = run_stroke(values)
        return record, straightness, [simulated_run(record, straightness, values)]
    simulation = Simulation(values)
    cycles: list[Run] = []
    opened = SimulatedRun(Path(options.bag), by_node(values), simulation.delay) if options.bag else nullcontext()
    # The bag first: Ctrl-C removes it also while the progress bar is imported.
    with opened as bag, working("simulating") as advance:
        for _ in range(options.strokes):
            record = simulation.run(
                lambda fraction: advance((len(cycles) + fraction) / options.strokes), bag.add if bag else None
            )
            cycles.append(simulated_run(record, simulation.map, values))
    simulation.save_learning()
    return record, simulation.map, cycles


def _worst(runs: Sequence[Run], kind: str) -> Verdict:
    """As of `worst`, by the true error p-p, which every simulated run has."""
    return worst([(run.metrics.true_pp, run.verdict) for run in runs], kind)
