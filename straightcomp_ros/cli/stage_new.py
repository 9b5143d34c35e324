"""Write the description of a stage into DIR: a commented stage file, and a copy of the survey of its guide.

On a terminal the most important facts are asked for; --set gives them without a question, and --yes takes the default
of all others. The strokes are those of the survey. What is not known well says so in `stage.uncertainty`."""

import argparse
import sys
from pathlib import Path
from typing import Any

from straightcomp_ros.cli.options import add_force, add_repeatable, output_folder
from straightcomp_ros.cli.output import CommandFailed, console
from straightcomp_ros.parameters.commented_file import commented
from straightcomp_ros.parameters.declaration import Declaration, ParameterError, declarations, from_mapping
from straightcomp_ros.parameters.node_parameters import STAGE
from straightcomp_ros.parameters.parameter_file import ALL_NODES
from straightcomp_ros.parameters.whole_file import write_whole
from straightcomp_ros.parameters.yaml_text import YamlError, load_yaml
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import MapParameters, find_survey
from straightcomp_ros.straightness.survey import read_survey

SUMMARY = "write the description of a stage, with a copy of its survey"
FILE, SURVEY = "stage.yaml", "survey.csv"
_ASKED = (
    "rate",
    "motion.speed",
    "motion.acceleration",
    "platform.mass",
    "actuator.turns",
    "actuator.pole_area",
    "actuator.air_gap",
    "actuator.bias_current",
    "actuator.current_limit",
    "friction.coulomb",
    "friction.static",
    "drive.bandwidth",
    "drive.dac_bits",
    "encoder.y_resolution",
)
"""What differs on nearly every stage."""
_HEAD = """\
# Description of the stage '{name}': each fact is here once, and every node, `straightcomp … --stage` and the launch
# files (stage:=…) take it from here. SI units. `straightcomp stage check` reads it as an engineer would.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folder", metavar="DIR", type=Path, help="folder of the stage, made if need be; its name is that of the stage")
    add("--survey", metavar="FILE", help="survey of the guide (default: the synthetic one, to be replaced)")
    add_repeatable(parser, "--set", "NAME=VALUE", "a fact, e.g. stage.platform.mass=8")
    add("--yes", action="store_true", help="ask nothing: what --set does not give takes its default")
    add_force(parser)


def run(options: argparse.Namespace) -> None:
    folder = output_folder("DIR", str(options.folder))
    file, survey = folder / FILE, folder / SURVEY
    declared = {one.name: one for one in declarations(StageParameters)}
    values: dict[str, Any] = {"name": folder.resolve().name, **dict(map(_assignment, options.set))}
    source = find_survey(options.survey or MapParameters().file)
    for path in (file, survey):
        if path.exists() and not options.force and not path.samefile(source):
            raise CommandFailed(f"{path}: is there already; name another folder, or give --force", exit_code=2)
    x = [run.x for run in read_survey(source).runs]
    first, last = max(float(one[0]) for one in x), min(float(one[-1]) for one in x)
    values = {"motion.start": first, "motion.stroke": last - first, **values, "guide.file": SURVEY}
    if sys.stdin.isatty() and not options.yes:
        values |= {name: _asked(declared[name]) for name in _ASKED if name not in values}
    # Refused before anything is written.
    from_mapping(StageParameters, values)
    if not (survey.exists() and survey.samefile(source)):
        write_whole(survey, source.read_bytes())
    described = {f"{STAGE}.{name}": value for name, value in values.items()}
    text = commented(ALL_NODES, declarations(StageParameters, f"{STAGE}."), described)
    write_whole(file, _HEAD.format(name=values["name"]) + "\n" + text)
    given = len(values)
    console.print(f"{file}: {given} facts given, {len(declared) - given} with their defaults", highlight=False)
    if options.survey is None:
        console.print(f"{survey} is the synthetic survey: replace it by that of your guide", highlight=False)
    console.print(f"next: straightcomp stage check {file}", highlight=False)


def _assignment(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals:
        raise ParameterError(f"--set {text!r}: allowed: NAME=VALUE, e.g. stage.platform.mass=8")
    return name.removeprefix(f"{STAGE}."), _value(value)


def _value(text: str) -> Any:
    try:
        return load_yaml(text)
    except YamlError:
        # The declaration refuses the text, with what is allowed.
        return text


def _asked(declaration: Declaration) -> Any:
    """The answer to a question on the terminal, asked again until it is allowed."""
    unit = f" {declaration.unit}" if declaration.unit else ""
    while True:
        try:
            answer = input(f"{declaration.description}{unit} [{declaration.default}]: ").strip()
        except EOFError as error:
            raise CommandFailed("no answer; give facts by --set, or --yes for the defaults", exit_code=2) from error
        try:
            return declaration.check(_value(answer)) if answer else declaration.default
        except ParameterError as error:
            print(f"  {error}")
