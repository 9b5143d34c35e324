"""Commission a stage: from a rough description to gains that are designed, measured and verified.

The steps follow each other; each is done once, and a later call goes on where the last one ended. A machine that is
not as described ends it with a sentence, the amplifier off and exit code 1. Without --graph the machine is the
simulated stage, in simulated time. --set driver.simulated.truth.… says how a simulated machine differs from its
description, --set stage.uncertainty.… how well it is known.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from straightcomp_ros.cli.options import (
    add_force,
    add_json,
    add_setting_option,
    in_range,
    named_files,
    output_folder,
    stage_values,
)
from straightcomp_ros.cli.output import CommandFailed, console, print_json, print_written, styled, working
from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.parameters.node_parameters import CommissioningNodeParameters
from straightcomp_ros.parameters.output_files import making
from straightcomp_ros.straightness.survey import Survey, read_survey
from straightcomp_ros.tuning.commissioning import LEARNED, MADE, STEP_NAMES
from straightcomp_ros.tuning.survey.survey_check import LEAST_POINTS, WIDEST_GAP
from straightcomp_ros.tuning.verbs import RUNNING, add_graph_option, graph_access, refuse_parameters_of_running

SUMMARY = "measure, tune and verify a stage, step by step"
PURPOSE = "tune"
_ACCEPTANCE = "acceptance"
_WORDS = {
    "evaluations": "candidates of the design, half as many as of one alone",
    "machines": "uncertain machines of its check",
    "learn": "before the acceptance let the controller learn from N strokes, and keep what it learned",
}
"""Options that are numbers of the node too, which declares their defaults and ranges."""
_NUMBERS = {one.name: one for one in declarations(CommissioningNodeParameters) if one.name in _WORDS}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="STAGE", nargs="?", help="stage file; not with --graph running")
    add_setting_option(parser)
    add_graph_option(parser)
    add = parser.add_argument
    add("--output", "-o", metavar="DIR", required=True, help="folder of the record, the bags and the results")
    only = f"do this step alone, even if it is done: {', '.join(STEP_NAMES)}"
    add("--only", choices=STEP_NAMES, metavar="STEP", help=only)
    for name, one in _NUMBERS.items():
        kind, text = in_range(int, one.minimum, one.maximum), f"{_WORDS[name]} (default: %(default)s)"
        add(f"--{name}", type=kind, default=one.default, metavar="N", help=text)
    check = "independent measurement of the guide at some places, at least twice: acceptance checks the map by it"
    add("--check-survey", metavar="FILE", help=check)
    require = (
        "tolerance: the certificate passes if the straightness after compensation is within UM, with its uncertainty"
    )
    add("--require", type=float, metavar="UM", help=require)
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    if options.require is not None and not 0.0 < options.require < math.inf:
        raise CommandFailed(f"--require: {options.require:g} µm; allowed: > 0", exit_code=2)
    if (options.graph == RUNNING) == bool(options.file):
        raise CommandFailed(
            f"STAGE: not with --graph {RUNNING}, whose nodes have a description; needed otherwise", exit_code=2
        )
    refuse_parameters_of_running(options, "--set")
    values = stage_values(options) if options.file else {}
    check = None
    if options.check_survey:
        # Wide meshes will do, for a check.
        check = read_survey(options.check_survey, min_points=LEAST_POINTS, max_gap=WIDEST_GAP)
    # Nodes that run may have been started in another folder.
    folder = output_folder("--output", options.output).resolve()
    # A record that is there is taken up again.
    reads = named_files(options, "--output")
    with making(folder, MADE, reads=reads, force=options.force, anew=False, changing=(LEARNED,)):
        if options.graph:
            with graph_access(options, values, folder) as (machine, found, report):
                _commission(options, folder, check, machine, found, report)
            return
        # Only here: the steps import all of the design.
        from straightcomp_ros.tuning.commissioning.machine import SimulatedMachine

        _commission(options, folder, check, SimulatedMachine(values), values, lambda doing: None)


def _commission(
    options: argparse.Namespace,
    folder: Path,
    check: Survey | None,
    machine: Any,
    values: Any,
    report: Callable[[str], None],
) -> None:
    from straightcomp_ros.tuning.commissioning.procedure import Procedure

    procedure = Procedure(
        machine,
        values,
        folder,
        evaluations=options.evaluations,
        machines=options.machines,
        learning_strokes=options.learn,
        check_survey=check,
        require=options.require,
    )
    # One that remains is done once more, with what is asked for now.
    if not options.only and _ACCEPTANCE not in procedure.remaining():
        accepted = procedure.outcomes[_ACCEPTANCE]
        # A command that goes on after an interrupt has asked for the same before.
        ignored = {
            "--check-survey": check is not None and accepted.figures.get("survey_check_sha256") != check.digest,
            "--learn": options.learn not in (0, accepted.figures.get("learning_strokes")),
        }
        for option in filter(ignored.get, ignored):
            remedy = f"--only {_ACCEPTANCE} repeats it"
            raise CommandFailed(f"{option}: step '{_ACCEPTANCE}' has passed without it; {remedy}", exit_code=2)
        if options.require is not None and not procedure.remaining():
            # A certificate is judged in a second.
            procedure.outcomes.pop(STEP_NAMES[-1])
    done: dict[str, Any] = {}
    failed = None
    for step in [options.only] if options.only else procedure.steps():
        report(step)
        with working(step) as advance:
            outcome = procedure.run(step, advance)
        done[step] = {"passed": outcome.passed, "sentence": outcome.sentence, "figures": outcome.figures}
        if not options.json:
            state = ("  ok", "green") if outcome.passed else ("fail", "red")
            console.print(styled(state, f"  {step}: {outcome.sentence}"))
        if not outcome.passed:
            failed = step
            break
    if options.json:
        print_json({"output": str(folder), "failed": failed, "remaining": procedure.remaining(), "steps": done})
    else:
        if failed == STEP_NAMES[-1]:
            # The same command would judge the same measurements in the same way.
            learned = f"--only {_ACCEPTANCE} --learn N lets the controller learn first"
            then = f"--only STEP measures again ({learned}); another --require judges the same measurements"
        elif left := ", ".join(procedure.remaining()):
            then = f"the same command{' without --only' * bool(options.only)} does the steps that are left: {left}"
        else:
            then = "all is done; --only STEP repeats a step"
        print_written(folder, then=then)
    if failed:
        raise CommandFailed(f"step '{failed}' did not pass; the amplifier is off")
