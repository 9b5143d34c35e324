"""Options that several verbs have, among them those that choose parameters: their declaration, and what is refused."""

import argparse
import math
import os
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from straightcomp_ros.cli.output import CommandFailed
from straightcomp_ros.parameters.output_files import check_writable, same_or_within

if TYPE_CHECKING:
    from straightcomp_ros.straightness.guide_map import MapParameters

N = TypeVar("N", int, float)


def add_repeatable(
    parser: argparse._ActionsContainer, option: str, metavar: str | None, text: str, **more: Any
) -> None:
    """Declare an option that may be given several times; its values are a list."""
    parser.add_argument(option, action="append", default=[], metavar=metavar, help=f"{text}; may be repeated", **more)


def _text(pattern: str, allowed: str) -> Callable[[str], str]:
    """The type of an option that takes texts of this ``pattern``."""

    def matching(text: str) -> str:
        if not re.fullmatch(pattern, text):
            raise argparse.ArgumentTypeError(f"{text!r}; allowed: {allowed}")
        return text

    return matching


def add_namespace(parser: argparse._ActionsContainer) -> None:
    """Declare ``--namespace``."""
    kind = _text(r"(?a)/?([A-Za-z_]\w*(/[A-Za-z_]\w*)*/?)?", "letters, digits and _, e.g. stage_1 or cell/stage_1")
    parser.add_argument("--namespace", default="", metavar="NAME", type=kind, help="namespace of the graph")


def add_dask(parser: argparse._ActionsContainer) -> None:
    """Declare ``--dask``, empty where it is not given."""
    # Dask itself takes 40 s to be sure.
    kind, text = _text(r"(.*:\d+)?", "HOST:PORT or tcp://HOST:PORT"), "run on the workers of this Dask scheduler"
    parser.add_argument("--dask", default="", metavar="ADDRESS", type=kind, help=text)


def in_range(kind: type[N], least: float, most: float = math.inf, unit: str = "") -> Callable[[str], N]:
    """The type of an option that takes finite numbers from ``least`` to ``most``, both included."""

    def within(text: str) -> N:
        with suppress(ValueError):
            # Python reads 1_0 as 10, and the digits of other scripts.
            if text.isascii() and "_" not in text and least <= (value := kind(text)) <= most and value < math.inf:
                return value
        allowed = f">= {least:.10g}" if most == math.inf else f"{least:.10g} to {most:.10g}"
        whole = "a whole number " if kind is int else ""
        raise argparse.ArgumentTypeError(f"{text!r}; allowed: {whole}{allowed}{unit and ' '}{unit}")

    return within


def add_json(parser: argparse._ActionsContainer) -> None:
    """Declare ``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


PICTURES = (".png", ".svg", ".pdf")
"""Endings of the files that plots are saved to."""


def add_force(parser: argparse._ActionsContainer) -> None:
    """Declare ``--force``, which verbs that write need to replace what they find."""
    text = "replace what is there, also what this tool did not make; never what the command reads"
    parser.add_argument("--force", action="store_true", help=text)


def output_file(
    options: argparse.Namespace, option: str, endings: tuple[str, ...] = (), *, updates: str | None = None
) -> Path | None:
    """The file that an option names, None where it is not given.

    A file that is there is replaced with ``--force`` only; one that another option or argument names, or that lies in a
    folder that one names, never. That of the name ``updates`` is read and written again.

    Raises:
        CommandFailed: exit code 2: it would replace a file, cannot be written, or has another ending.
    """
    own = attribute(option)
    name = getattr(options, own)
    if not name:
        return None
    path = Path(name)
    if endings and path.suffix.lower() not in endings:
        raise CommandFailed(f"{option} {name}; allowed: a file name that ends with {', '.join(endings)}", exit_code=2)
    if path.is_dir():
        raise CommandFailed(f"{option} {name}: is a folder; name a file", exit_code=2)
    if not path.parent.is_dir():
        raise CommandFailed(f"{option} {name}: there is no folder {path.parent}; make it first", exit_code=2)
    # Two outputs of one name, neither of which is there yet, also through a link.
    if not path.exists() and os.path.realpath(path) in map(os.path.realpath, _names(options, own)):
        raise CommandFailed(f"{option} {name}: another option names it too; name another file", exit_code=2)
    if path.is_file() and not (updates and same_or_within(path, Path(updates))):
        for read in named_files(options, option):
            if same_or_within(path, read):
                raise CommandFailed(f"{option} {name}: is an input ({read}); name another file", exit_code=2)
        if not options.force:
            raise CommandFailed(f"{option} {name}: is there already; name another file, or give --force", exit_code=2)
    if path.exists() and not os.access(path, os.W_OK):
        raise CommandFailed(f"{option} {name}: cannot be written; check its permissions", exit_code=2)
    try:
        check_writable(path)
    except OSError as error:
        raise CommandFailed(f"{option} {name}: cannot be written: {error.strerror}", exit_code=2) from error
    return path


def attribute(option: str) -> str:
    """The name under which argparse keeps an option."""
    return option.strip("-").replace("-", "_")


def named_files(options: argparse.Namespace, without: str) -> list[Path]:
    """Files and folders that are there and that options or arguments name, but for one's; with files that are named as
    ``NAME=FILE``, and those that a YAML file among them names."""
    from straightcomp_ros.parameters.yaml_text import YamlError, load_yaml

    names = _names(options, attribute(without))
    found = [Path(name) for name in names if os.path.exists(name)]
    found += [Path(value) for _, _, value in (name.partition("=") for name in names) if os.path.isfile(value)]
    for file in [path for path in found if path.is_file() and path.suffix in (".yaml", ".yml")]:
        with suppress(YamlError, OSError):
            paths = [os.path.expanduser(text) for text in _texts(load_yaml(file))]
            found += [place / path for path in paths for place in (Path(), file.parent) if os.path.isfile(place / path)]
    return found


WORDS = {
    "verb", "tool", "law", "laws", "graph", "hardware", "format", "unit", "moved", "only", "error", "known", "smooth",
    "name", "namespace", "dask", "sensor", "position", "remap", "note", "x_column", "deviation_column", "since", "sql",
}  # fmt: skip
"""Options and arguments whose texts name no file, though a file or folder may be called so."""


def _names(options: argparse.Namespace, without: str) -> list[str]:
    """Texts of options and arguments that may name a file, but for one's."""
    values = [value for key, value in vars(options).items() if key != without and key not in WORDS]
    values += [one for value in values if isinstance(value, list) for one in value]
    return [str(value) for value in values if isinstance(value, (str, Path)) and str(value)]


def _texts(tree: Any) -> list[str]:
    """The texts among values of YAML."""
    if isinstance(tree, (dict, list)):
        return [text for value in (tree.values() if isinstance(tree, dict) else tree) for text in _texts(value)]
    return [tree] if isinstance(tree, str) else []


def output_folder(option: str, name: str, *, empty: bool = False) -> Path:
    """The folder that an option names, made if need be; CommandFailed with exit code 2 if it cannot be made, or is not
    ``empty`` where it has to be."""
    path = Path(name)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = "is a file" if path.exists() else f"cannot be made: {error.strerror}"
        raise CommandFailed(f"{option} {name}: {why}; name another folder", exit_code=2) from error
    if empty and any(path.iterdir()):
        raise CommandFailed(f"{option} {name}: the folder is not empty; name another", exit_code=2)
    return path


Values = dict[str, dict[str, Any]]
"""Values of parameters by node and dotted name."""


def add_parameter_options(parser: argparse.ArgumentParser) -> None:
    """Add --stage, --law, --params-file and --set."""
    # Only here: what these import takes longer than most verbs' help.
    from straightcomp_ros.control.laws import LAWS
    from straightcomp_ros.parameters.parameter_file import DEFAULT_FILE, DEFAULT_STAGE

    add = parser.add_argument
    add("--stage", metavar="FILE", help=f"description of the stage (default: the installed {DEFAULT_STAGE})")
    add("--law", choices=LAWS, help="control law (default: the parameter file's)")
    add("--params-file", metavar="FILE", help=f"ROS 2 parameter file (default: the installed {DEFAULT_FILE})")
    add_setting_option(parser)


def add_setting_option(parser: argparse.ArgumentParser) -> None:
    """Add --set."""
    add_repeatable(parser, "--set", "NODE.NAME=VALUE", "set one parameter, e.g. stage.platform.mass=3.5")


def add_stage_argument(parser: argparse.ArgumentParser) -> None:
    """Add the stage file as an argument of its own."""
    parser.add_argument("file", metavar="STAGE", help="stage file")


def add_guide_option(parser: argparse.ArgumentParser) -> None:
    """Add --stage-file, of which :func:`chosen_guide` makes the demands on a survey."""
    text = "stage file, whose stage.guide demands of the survey and makes its map (default: no stage's; any travel)"
    parser.add_argument("--stage-file", metavar="FILE", help=text)


def chosen_guide(options: argparse.Namespace) -> "MapParameters":
    """``stage.guide`` of the stage file of :func:`add_guide_option`, or that of no described stage; raises
    ParameterError."""
    from straightcomp_ros.analysis.map_building import MAP
    from straightcomp_ros.parameters.node_parameters import node_parameters

    if options.stage_file is None:
        return MAP
    return node_parameters("controller", _checked(None, options.stage_file, {})).stage.guide


def chosen_parameters(options: argparse.Namespace) -> Values:
    """Values by node and dotted name, checked; raises ParameterError."""
    return _checked(options.params_file, options.stage, chosen_changes(options), getattr(options, "namespace", ""))


def stage_values(options: argparse.Namespace) -> Values:
    """The same with the stage file of :func:`add_stage_argument`, and --set where the verb has it."""
    return _checked(None, options.file, settings(getattr(options, "set", [])))


def chosen_changes(options: argparse.Namespace) -> Values:
    """What --set and --law change, by node and dotted name; raises ParameterError."""
    changes = settings(options.set)
    if options.law:
        changes.setdefault("controller", {})["control.law"] = options.law
    return changes


def _checked(params_file: str | None, stage: str | None, changes: Values, namespace: str = "") -> Values:
    from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, changed, node_parameters
    from straightcomp_ros.parameters.parameter_file import shipped_parameters

    values = changed(shipped_parameters(params_file, stage, namespace), changes)
    for node in NODE_PARAMETERS:
        node_parameters(node, values)
    return values


def settings(assignments: list[str]) -> Values:
    """What assignments NODE.NAME=VALUE set, by node and dotted name; raises ParameterError for another form.

    A number or truth value is a text where the parameter is one: ``stage.serial=0123``.
    """
    from straightcomp_ros.parameters.declaration import ParameterError, declarations
    from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, STAGE
    from straightcomp_ros.parameters.yaml_text import YamlError, load_yaml

    changes: Values = {}
    for assignment in assignments:
        target, equals, text = assignment.partition("=")
        node, dot, name = target.partition(".")
        if not (equals and dot) or node not in (STAGE, *NODE_PARAMETERS):
            known = ", ".join((STAGE, *NODE_PARAMETERS))
            raise ParameterError(f"--set {assignment!r}: allowed: NODE.NAME=VALUE with NODE one of {known}")
        try:
            value = load_yaml(text)
        except YamlError as error:
            raise ParameterError(f"--set {assignment!r}: {text!r} is no YAML; put a text in quotes") from error
        # Each node that works with the stage declares all of its facts.
        of, full = ("driver", target) if node == STAGE else (node, name)
        is_text = any(one.name == full and one.kind is str for one in declarations(NODE_PARAMETERS[of]))
        changes.setdefault(node, {})[name] = text.strip() if is_text and isinstance(value, (int, float)) else value
    return changes
