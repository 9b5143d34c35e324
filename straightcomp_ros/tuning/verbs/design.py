"""Design the gains of a law for a stage: the least error that the stage's uncertainty allows, with what limits it.

Takes up to two minutes on two cores. Where no gains have margins, it says what would have to change; exit code 1."""

import argparse
import os
import re
import time
from collections.abc import Iterable
from pathlib import Path
from shlex import quote
from typing import Any

from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.cli.options import add_force, add_json, add_stage_argument, in_range, output_file, stage_values
from straightcomp_ros.cli.output import CommandFailed, console, print_json, print_written, progress_bar
from straightcomp_ros.cli.results import titled_table
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.offline.scenario import make_scenario
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.parameter_file import ALL_NODES, as_yaml
from straightcomp_ros.parameters.yaml_text import YamlError, load_yaml
from straightcomp_ros.tuning.design.automatic_design import SHIPPED_QUIET, Design, DesignFigures, design_gains
from straightcomp_ros.tuning.design.error_budget import remarks
from straightcomp_ros.tuning.design.gains import SEARCHED

SUMMARY = "design the gains of a law for a stage"
PURPOSE = "tune"
_KEY = f"{ALL_NODES}/controller"
_BEGIN, _END = "# Gains by `straightcomp design`:", "# End of the designed gains."
_OURS = re.compile(rf"^{re.escape(_BEGIN)}.*?^{re.escape(_END)}\n\n?", re.MULTILINE | re.DOTALL)
_HEAD = re.compile(r"\A(?:(?:%.*|[ \t]*(?:#.*)?)\n)*---[ \t]*(?:#.*)?\n")
"""Directives, comments and the marker that begin a YAML document: what stands before the marker is none of it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_stage_argument(parser)
    add, count = parser.add_argument, in_range(int, 1, 100_000)
    add("--output", "-o", metavar="FILE", help="write the stage file with the gains; may be STAGE itself")
    add("--law", choices=LAWS, default="smc_observer", help="law to design (default: %(default)s)")
    quiet = "0 for the least error, 1 for the quietest coils (default: %(default)s)"
    add("--quiet", type=in_range(float, 0.0, 1.0), default=SHIPPED_QUIET, metavar="Q", help=quiet)
    machines = "uncertain machines of the check (default: %(default)s)"
    add("--machines", type=count, default=200, metavar="N", help=machines)
    add("--evaluations", type=count, default=400, metavar="N", help="candidates of a search (default: %(default)s)")
    add("--seed", type=in_range(int, 0, 2**31), default=1, metavar="N", help="of all that is drawn (default: 1)")
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    if options.law not in SEARCHED:
        allowed = f"allowed: {', '.join(SEARCHED)}, or one with an entry in SEARCHED (tuning/design/gains.py)"
        raise CommandFailed(f"--law {options.law}: its gains are not searched; {allowed}", exit_code=2)
    source = Path(options.file)
    values = stage_values(options)
    output = output_file(options, "--output", updates=options.file)
    if output is not None:
        _writable(source, output)
    scenario, began = make_scenario(values, [options.law]), time.monotonic()
    with progress_bar() as bar:
        task = bar.add_task("design", total=1.0)
        design = design_gains(
            scenario,
            options.law,
            quiet=options.quiet,
            evaluations=options.evaluations,
            machines=options.machines,
            seed=options.seed,
            progress=lambda part, fraction: bar.update(task, description=part, completed=fraction),
        )
    if output is not None:
        write_whole(output, _with_section(source, _section(design)))
    if options.json:
        name = scenario.description.name
        print_json({"stage": name, **_in_json(design), "seconds": time.monotonic() - began, "output": options.output})
    else:
        _print(design, scenario.description.name)
        if output is not None:
            print_written(output, then=f"straightcomp simulate --stage {quote(str(output))}")
        else:
            console.print("Nothing is written: -o FILE writes the stage file with these gains.")
    return 0 if design.holds else 1


def _writable(source: Path, output: Path) -> None:
    """Refuse to write what would lose something, before two minutes of work."""
    if os.path.dirname(os.path.realpath(output)) != os.path.dirname(os.path.realpath(source)):
        raise CommandFailed(
            f"--output {output}: is in another folder than {source}, where the survey is; name a file there",
            exit_code=2,
        )
    rest = load_yaml(_OURS.sub("", source.read_text(encoding="utf-8-sig"))) or {}
    for key in [key for key in rest if str(key).rsplit("/", 1)[-1] == "controller"]:
        words = "to which the gains would be added; move its parameters to a file for --params-file"
        raise CommandFailed(f"{source}: has a section '{key}' of its own, {words}", exit_code=2)
    _with_section(source, [f"{_KEY}: {{}}"])


def _section(design: Design) -> list[str]:
    """Lines of the section of gains."""
    figures, values = design.figures, {**design.values, **design.newer}
    return [
        f"{_BEGIN} law {design.law}, --quiet {design.quiet:g};",
        f"# {with_digits(figures.pp.median * 1e6, 3)} µm p-p at {with_digits(figures.work.median * 1e3, 2)} mA from "
        "sample to sample.",
        f"{_KEY}:",
        "  ros__parameters:",
        f"    control.law: {as_yaml(design.law)}",
        *(f"    {name}: {as_yaml(float(f'{value:.6g}'))}" for name, value in values.items()),
        _END,
    ]


def _with_section(source: Path, section: Iterable[str]) -> str:
    """The stage file with a section of gains at the beginning of its document, in the place of an earlier one.

    Raises:
        CommandFailed: its form takes no section of lines, as the flow style.
    """
    rest, added = _OURS.sub("", source.read_text(encoding="utf-8-sig")), "\n".join(section) + "\n"
    head = match.group() if (match := _HEAD.match(rest)) else ""
    text = f"{head}{added}\n{rest.removeprefix(head)}"
    try:
        kept = load_yaml(text) == {**load_yaml(added), **(load_yaml(rest) or {})}
    except YamlError:
        kept = False
    if not kept:
        words = "with each node's name at the beginning of a line; or leave out --output, and add the gains by hand"
        why = "a section of gains cannot be put into it; write it in block style"
        raise CommandFailed(f"{source}: {why}, {words}", exit_code=2)
    return text


def _in_json(design: Design) -> dict[str, Any]:
    return {
        "law": design.law,
        "quiet": design.quiet,
        "values": {**design.values, **design.newer},
        "predicted": _figures(design.figures),
        "closed_form": {"values": dict(design.start_values), **_figures(design.start_figures)},
        "uncertain_machines": design.verification.to_display(),
        **design.limits_to_display(),
        "modes_answered_by": design.shape,
        "warnings": design.warnings,
        "rounds": design.rounds,
    }


_SHOWN = {
    "true_pp_um": ("true error p-p", 1e6, "µm", 3),
    "true_rms_um": ("true error RMS", 1e6, "µm", 4),
    "control_rms_step_mA": ("step of the current", 1e3, "mA", 2),
    "resting_rms_step_mA": ("the same at rest", 1e3, "mA", 2),
}
"""The figures in their order, by their names in JSON: words, factor from SI, unit, digits."""


def _figures(figures: DesignFigures) -> dict[str, Any]:
    return {name: one.scaled(_SHOWN[name][1])._asdict() for name, one in zip(_SHOWN, figures, strict=True)}


def _print(design: Design, name: str) -> None:
    gains = ((key, f"{design.start_values[key]:.4g}", f"{value:.4g}") for key, value in design.values.items())
    title = f"Law '{design.law}' for stage '{name}'"
    console.print(titled_table(title, "parameter", "closed form", "designed", rows=gains))
    if design.shape != "no filter":
        console.print(f"The platform's modes are answered by {design.shape}.")
    promised = (
        (words, *(one.scaled(factor).text(digits) for one in both), unit)
        for (words, factor, unit, digits), *both in zip(
            _SHOWN.values(), design.start_figures, design.figures, strict=True
        )
    )
    headings = ("figure", "closed form", "designed", "unit")
    console.print(titled_table("What it promises", *headings, left=("unit",), rows=promised))
    budget = ((one.cause, with_digits(one.pp * 1e6, 3), with_digits(one.rms * 1e6, 4)) for one in design.budget)
    title = "What limits it, one cause changed at a time"
    console.print(titled_table(title, "cause", "p-p [µm]", "RMS [µm]", rows=budget))
    if design.newer:
        words = f"reference_lead: {design.lead * 1e3:.2g} ms; older references miss the motion by more than a count"
        console.print(words)
    for remark in [*design.warnings, *remarks(design.budget, 1e6)]:
        console.print(remark)
    for state, limit in design.limits.items():
        console.print(
            f"{state}: stable for gains × {limit.gain_low:.2f} to {limit.gain_high:.2f}, of the amplifier "
            f"× {limit.amplifier_low:.2f} to {limit.amplifier_high:.2f}, masses × {limit.mass_low:.2f} to "
            f"{limit.mass_high:.2f}, delays up to {limit.longest_delay:.2f} samples; phase {limit.phase:.0f}°",
        )
    sweep = design.verification
    shown = ", ".join(f"{key} {with_digits(value * 1e6, 2)}" for key, value in sweep.percentiles("pp").items())
    console.print(f"{sweep.trials} uncertain machines, p-p in µm: {shown}; {sweep.verdict}")
