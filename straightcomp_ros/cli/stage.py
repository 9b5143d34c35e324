"""The description of a stage: write one, check it, and show what follows from it."""

import argparse
import itertools
import math
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any

from straightcomp_ros.cli import Tool
from straightcomp_ros.cli.options import (
    PICTURES,
    add_force,
    add_json,
    add_repeatable,
    add_stage_argument,
    output_file,
    output_folder,
    settings,
    stage_values,
)
from straightcomp_ros.cli.output import CommandFailed, console, notes, print_json, print_written
from straightcomp_ros.cli.results import show_findings, titled_table
from straightcomp_ros.control.laws import OPEN_LOOP
from straightcomp_ros.parameters.declaration import (
    Declaration,
    ParameterError,
    RefusedParameter,
    declarations,
    from_mapping,
)
from straightcomp_ros.parameters.node_parameters import STAGE, node_parameters
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.parameter_file import ALL_NODES, commented
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import find_survey, load_map
from straightcomp_ros.straightness.survey import read_survey
from straightcomp_ros.straightness.survey_header import SurveyError

SUMMARY = "describe your own stage: write the description, check it, show what follows"
PURPOSE = "set up"
FILE, SURVEY = "stage.yaml", "survey.csv"
_ASKED = """
rate motion.speed motion.acceleration platform.mass actuator.turns actuator.pole_area actuator.air_gap
actuator.bias_current actuator.current_limit friction.coulomb friction.static drive.bandwidth drive.dac_bits
encoder.y_resolution
"""
"""What differs on nearly every stage."""
_HEAD = """\
# Description of the stage {name!r}: each fact is here once, and every node, `straightcomp … --stage` and the launch
# files (stage:=…) take it from here. SI units. `straightcomp stage check` reads it as an engineer would.
"""


def _new_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folder", metavar="DIR", type=Path, help="folder of the stage, made if need be; its name is that of the stage")
    add("--survey", metavar="FILE", help="survey of the guide (default: the synthetic one, to be replaced)")
    add_repeatable(parser, "--set", "NAME=VALUE", "a fact, e.g. stage.platform.mass=8")
    add("--yes", action="store_true", help="ask nothing: what --set does not give takes its default")
    add_force(parser)


def _new(options: argparse.Namespace) -> None:
    """Write the description of a stage into DIR: a commented stage file, and a copy of the survey of its guide.

    On a terminal the most important facts are asked for; --set gives them without a question, and --yes takes the
    default of all others. The strokes are those of the survey. What is not known well says so in
    `stage.uncertainty`."""
    file, survey = options.folder / FILE, options.folder / SURVEY
    given = _given(options.set)
    guide = from_mapping(StageParameters, given).guide
    source = find_survey(options.survey or guide.file)
    for path in (file, survey):
        if path.exists() and not options.force and not path.samefile(source):
            raise CommandFailed(f"{path}: is there already; name another folder, or give --force", exit_code=2)
    x = [run.x for run in read_survey(source, min_points=guide.min_points, max_gap=guide.max_gap).runs]
    first, last = max(float(one[0]) for one in x), min(float(one[-1]) for one in x)
    made = [one for one in (options.folder, *options.folder.parents) if not one.exists()]
    # Before the questions: no answers are lost where it cannot be made.
    folder = output_folder("DIR", str(options.folder))
    found = {"name": folder.resolve().name, "motion.start": first, "motion.stroke": last - first}
    try:
        # What survey, folder and --set give is refused before anything is asked.
        from_mapping(StageParameters, {**found, **given})
        if sys.stdin.isatty() and not options.yes:
            given = _answered(found, given)
    except BaseException:
        for one in made:
            one.rmdir()
        raise
    values = {**found, **given, "guide.file": SURVEY}
    if not (survey.exists() and survey.samefile(source)):
        write_whole(survey, source.read_bytes())
    described = {f"{STAGE}.{name}": value for name, value in values.items()}
    text = commented(ALL_NODES, declarations(StageParameters, f"{STAGE}."), described)
    write_whole(file, _HEAD.format(name=values["name"]) + "\n" + text)
    console.print(f"{file}: facts given: {len(given)}; name and strokes by folder and survey, defaults for the others")
    if options.survey is None and "guide.file" not in given:
        console.print(f"{survey} is the synthetic survey: replace it by that of your guide")
    print_written(file, survey, then=f"straightcomp stage check {quote(str(file))}")


def _given(assignments: Iterable[str]) -> dict[str, Any]:
    """Facts by name from NAME=VALUE, with or without ``stage.`` before it."""
    return settings([f"{STAGE}.{one.removeprefix(f'{STAGE}.')}" for one in assignments]).get(STAGE, {})


def _answered(found: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """``given`` with the answers to the questions on the terminal. Of answers that do not fit each other all that the
    refusal names are asked for again: any of them may be the wrong one."""
    declared = {one.name: one for one in declarations(StageParameters)}
    names, given = [name for name in _ASKED.split() if name not in given], dict(given)
    while True:
        for name in names:
            present = {**found, **given}.get(name, declared[name].default)
            answer = _asked(replace(declared[name], default=present))
            given |= {} if answer is None else {name: answer}
        try:
            from_mapping(StageParameters, {**found, **given})
            return given
        except RefusedParameter as error:
            print(f"  {error}")
            names = [name for name in declared if f"'{name}'" in str(error)]


def _asked(declaration: Declaration) -> Any:
    """The answer to a question on the terminal, asked again until it is allowed; None for the default."""
    unit = f" {declaration.unit}" if declaration.unit else ""
    while True:
        try:
            answer = input(f"{declaration.description}{unit} [{declaration.default}]: ").strip()
        except EOFError as error:
            raise CommandFailed("no answer; give facts by --set, or --yes for the defaults", exit_code=2) from error
        try:
            return declaration.check(*_given([f"{declaration.name}={answer}"]).values()) if answer else None
        except ParameterError as error:
            print(f"  {error}")


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_stage_argument(parser)
    add_json(parser)


def _check_arguments(parser: argparse.ArgumentParser) -> None:
    _arguments(parser)
    parser.add_argument("--plot", metavar="FILE", help="also save the page of the map (PDF, PNG or SVG)")
    add_force(parser)


def _check(options: argparse.Namespace) -> int:
    """Check the description of a stage as an engineer would read it: survey, travel, reference, stability, force,
    quanta, and the DBC file of a board on CAN.

    Each finding is ok, warn (it works, but less well) or fail. The exit code is 1 if one fails."""
    from straightcomp_ros.doctor.stage_findings import board_findings, stage_findings
    from straightcomp_ros.offline.scenario import node_set

    plot, values = output_file(options, "--plot", PICTURES), stage_values(options)
    nodes = node_set(values)
    nodes.check_rates()
    controller = nodes.controller
    found = stage_findings(controller, nodes.feedforward.feedforward)
    code = show_findings(itertools.chain(found, board_findings(nodes.driver)), json=options.json)
    if plot is not None:
        from straightcomp_ros.analysis.map_building import as_it_is
        from straightcomp_ros.analysis.map_page import plot_map

        # A survey that is refused is a finding above.
        with suppress(SurveyError):
            plot_map(as_it_is(controller.stage.guide), plot, controller.stage.name)
            notes.print(f"written: {plot}")
    if not (code or options.json):
        file = quote(options.file)
        notes.print(f"next: straightcomp design {file} -o {file} for gains of its own, or simulate --stage {file}")
    return code


def _show(options: argparse.Namespace) -> None:
    """Show what follows from the description of a stage: stiffnesses, poles, counts, demands, margins, bus load."""
    from straightcomp_ros.doctor.stage_findings import Consequences

    values = stage_values(options)
    controller = node_parameters("controller", values)
    stage = controller.stage
    found = Consequences(stage, controller.control, load_map(stage.guide))
    figures = _figures(stage, found)
    if options.json:
        print_json({"name": stage.name, "law": controller.control.law, **{key: value for key, _, _, value in figures}})
        return
    title = f"Stage '{stage.name}', law '{controller.control.law}'"
    table = titled_table(title, "what follows", "value", "unit", left=("unit",))
    without = "there is no loop" if controller.control.law == OPEN_LOOP else "the law switches"
    for _, words, unit, value in figures:
        table.add_row(words, without if value is None else f"{value:.4g}", unit)
    console.print(table)


def _figures(stage: StageParameters, found: Any) -> list[tuple[str, str, str, float | None]]:
    """Key, words, unit and value of each figure."""
    margins: Any = found.margins
    magnets = stage.actuator

    def of_loop(name: str) -> float | None:
        return None if margins is None else float(getattr(margins, name))

    return [
        ("current_stiffness_N_per_A", "K_i, force per current", "N/A", magnets.current_stiffness),
        ("position_stiffness_N_per_m", "K_y, negative stiffness of the magnets", "N/m", magnets.position_stiffness),
        ("unstable_pole_Hz", "unstable pole of the platform", "Hz", found.unstable_pole / (2.0 * math.pi)),
        ("dead_time_ms", "dead time: hold, delay, amplifier", "ms", stage.dead_time * 1e3),
        ("difficulty", "unstable pole times dead time (easy below 0.5)", "", found.difficulty),
        ("correction_um", "largest correction, to each side", "µm", found.correction * 1e6),
        ("reference_speed_um_per_s", "largest speed of the reference", "µm/s", found.reference_speed * 1e6),
        ("reference_acceleration", "largest acceleration of the reference", "m/s²", found.reference_acceleration),
        ("breakaway_current_A", "current that overcomes static friction", "A", found.breakaway_current),
        ("holding_current_A", "largest current of a stroke", "A", found.holding_current),
        ("dac_force_mN", "force of one D/A step", "mN", found.dac_force * 1e3),
        (
            "dac_displacement_nm",
            "move of one D/A step: on the bristles, if free within the dead time",
            "nm",
            found.dac_displacement * 1e9,
        ),
        ("encoder_floor_um", "p-p error that the encoder's count leaves", "µm", found.encoder_floor * 1e6),
        ("gain_low", "loop is stable from a gain of", "", of_loop("gain_low")),
        ("gain_high", "loop is stable up to a gain of", "", of_loop("gain_high")),
        ("phase_deg", "phase margin", "°", of_loop("phase")),
        ("longest_delay_s", "longest delay of commands", "s", of_loop("longest_delay")),
        ("can_load", "classic CAN of 1 Mbit/s busy", "", found.can_load),
        ("can_fd_load", "CAN FD of 5 Mbit/s busy", "", found.can_fd_load),
    ]


TOOLS = {
    "new": Tool("write the description of a stage, with a copy of its survey", _new_arguments, _new),
    "check": Tool("check a description: what does not fit together, why, and what helps", _check_arguments, _check),
    "show": Tool("show what follows from a description: stiffnesses, poles, counts, margins", _arguments, _show),
}
