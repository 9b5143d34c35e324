"""Reads and writes the ROS 2 parameter file that sets the parameters of all nodes; offline runs read the same file."""

import hashlib
import os
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from straightcomp_ros.parameters.declaration import Declaration, ParameterError, belongs_to_ros, to_mapping
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, STAGE, Values, by_node, node_parameters
from straightcomp_ros.parameters.share import named_file, share_path
from straightcomp_ros.parameters.yaml_text import PARAMETERS, bounded_bytes, dump_yaml, node_sections

ALL_NODES = "/**"
"""Key of a parameter file for what holds for every node."""
DEFAULT_FILE = "config/straightcomp.yaml"
DEFAULT_STAGE = "config/stage_synthetic.yaml"
"""Installed files: settings of the nodes, and the description of the synthetic stage."""
_OF_STAGE = ("guide.file", "motion.file")
_FILES = (
    *((STAGE, name) for name in _OF_STAGE),
    *((node, f"{STAGE}.{name}") for node in NODE_PARAMETERS for name in _OF_STAGE),
    *(("driver", "can.dbc"), ("driver", "simulated.truth.guide")),
    ("driver", "simulated.truth.disturbances.force_file"),
)
"""Node and parameter of the files that a stage file may name; they are read and never written."""
_LEVELS = {"**": r"(/\w+)*", "*": r"/\w+"}
"""What stands for levels of a node's full name in a key of a parameter file, as for rcl."""


class OtherNamespaceError(ParameterError):
    """A parameter file is for nodes of other namespaces only."""


def read_parameter_file(*paths: str | Path, namespace: str = "") -> dict[str, dict[str, Any]]:
    """Values of a ROS 2 parameter file, or of several as rcl joins them, for nodes in ``namespace``, by node and dotted
    name, with a key for each node of this package.

    As for rcl, a key of the file is a node's full name, with ``*`` for one level and ``**`` for any (``/**/driver``,
    ``driver``), or ``/**`` for all; other nodes' sections are left out, and of several with a parameter the last
    counts, where those of one key are one, at the place of the first. The description of the stage, which it gives to
    all nodes, has the key :data:`STAGE` here. Parameters that ROS itself declares on every node are left out.

    Raises:
        ParameterError: a file cannot be read, is not YAML, is empty, has another layout, or names an unknown node.
        OtherNamespaceError: there are sections for other namespaces only.
    """
    return _values_of(paths[-1], [section for path in paths for section in _sections_of(path)], namespace)


def _sections_of(path: str | Path) -> list[tuple[str, dict[str, Any]]]:
    try:
        return node_sections(Path(path))
    except OSError as error:
        raise ParameterError(f"parameter file {path}: cannot be read: {error.strerror}") from error
    except ParameterError as error:
        raise ParameterError(f"parameter file {path}: {error}") from error


def _values_of(
    path: str | Path, sections: Iterable[tuple[str, dict[str, Any]]], namespace: str
) -> dict[str, dict[str, Any]]:
    source = f"parameter file {path}"
    joined: dict[str, dict[str, Any]] = {}
    for key, given in sections:
        joined.setdefault(key, {}).update(given)
    values: dict[str, dict[str, Any]] = {name: {} for name in (STAGE, *NODE_PARAMETERS)}
    before = "".join(f"/{level}" for level in namespace.split("/") if level)
    foreign = []
    for key, every in joined.items():
        name = key.rsplit("/", 1)[-1]
        given = {parameter: value for parameter, value in every.items() if not belongs_to_ros(parameter)}
        if name not in (*NODE_PARAMETERS, *_LEVELS):
            raise ParameterError(f"{source}: node '{key}' is unknown; known: {', '.join(NODE_PARAMETERS)}, {ALL_NODES}")
        pattern = "".join(_LEVELS.get(level, re.escape(f"/{level}")) for level in key.split("/") if level)
        # A key that ends with stars is for all nodes or for none.
        if not re.fullmatch(pattern, f"{before}/{'driver' if name in _LEVELS else name}"):
            foreign.append(key)
        elif name in NODE_PARAMETERS:
            values[name].update(given)
        else:
            for parameter, value in given.items():
                group, _, rest = parameter.partition(".")
                if group != STAGE or not rest:
                    raise ParameterError(f"{source}: '{parameter}' under '{key}'; allowed for all nodes: {STAGE}.…")
                values[STAGE][rest] = value
                for node in NODE_PARAMETERS:
                    values[node].pop(parameter, None)
    if foreign and len(foreign) == len(joined):
        place = f"namespace {before}" if before else "no namespace"
        raise OtherNamespaceError(
            f"{source}: is for other nodes than those in {place}: {', '.join(foreign)}; allowed: {ALL_NODES}/NODE"
        )
    return values


def files_beside(
    path: str | Path, values: Mapping[str, Mapping[str, Any]], joined: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, str]]:
    """Full names, by node and parameter, of the files in the folder of the stage file ``path`` with ``values``; of what
    is nowhere too, so that its refusal names that folder. Only of those that count where the file is ``joined`` with
    others."""
    folder = Path(path).resolve().parent
    found: dict[str, dict[str, str]] = {}
    for node, name in _FILES:
        file = values[node].get(name)
        if not isinstance(file, str) or not file or joined[node].get(name) != file:
            continue
        file = os.path.expanduser(file)
        if os.path.isfile(folder / file) or not os.path.exists(named_file(file)):
            found.setdefault(node, {})[name] = str(folder / file)
    return found


def file_digests(values: Values) -> dict[str, str]:
    """SHA-256 of the content of each file that the parameters ``values`` name for reading, by the name that they give
    it. A file that cannot be read has none: its reader refuses it."""
    nodes = (to_mapping(node_parameters(node, values)) for node in NODE_PARAMETERS if node in values)
    read = {f"{STAGE}.{name}" if node == STAGE else name for node, name in _FILES}
    names = {str(node[name]) for node in nodes for name in read & node.keys() if node[name]}
    found: dict[str, str] = {}
    for name in sorted(names):
        with suppress(OSError):
            found[name] = hashlib.sha256(bounded_bytes(named_file(name))).hexdigest()
    return found


def shipped_parameters(
    params_file: str | None = None, stage: str | None = None, namespace: str = ""
) -> dict[str, dict[str, Any]]:
    """Values by node and dotted name of a parameter file and a stage file for nodes in ``namespace``, as rcl joins
    them; the installed ones by default.

    A parameter file that is named describes the stage too, unless there is a ``stage`` file. ParameterError, too, for
    a fact of the stage file that rcl lets no node have.
    """
    path = params_file or share_path(DEFAULT_FILE)
    # Once: a pipe cannot be read again.
    sections = _sections_of(path)
    values = _values_of(path, sections, namespace)
    if stage or not params_file:
        path = stage or share_path(DEFAULT_STAGE)
        described = _sections_of(path)
        own = _values_of(path, described, namespace)
        values = _values_of(path, [*sections, *described], namespace)
        for node in NODE_PARAMETERS:
            for name in own[node].keys() - values[node].keys():
                raise ParameterError(
                    f"parameter file {path}: '{name}' of one node, {own[node][name]!r}, counts for no node: its "
                    f"section joins that of the parameter file, before {ALL_NODES} of this one; name the section "
                    f"'{node}', or in a namespace '/NAMESPACE/{node}'"
                )
        for node, found in files_beside(path, own, values).items():
            values[node].update(found)
    return values


def as_parameter_file(values: Mapping[str, Mapping[str, Any]]) -> str:
    """Text of a ROS 2 parameter file with these values, by node and dotted name."""
    # What is given for all nodes comes last: a parameter on a node's command line joins it, and rcl takes the last.
    described = {f"{STAGE}.{name}": value for name, value in values.get(STAGE, {}).items()}
    own = {name for node, section in values.items() if node != STAGE for name in section}
    common = {name: value for name, value in described.items() if name not in own}
    sections = {
        f"{ALL_NODES}/{node}": {name: value for name, value in section.items() if name not in common}
        for node, section in by_node(values).items()
    } | {ALL_NODES: common}
    # rcl refuses an empty section.
    tree = {key: {PARAMETERS: section} for key, section in sections.items() if section}
    return dump_yaml(tree)


def commented(key: str, declared: Iterable[Declaration], values: Mapping[str, Any] | None = None) -> str:
    """The section ``key``: each parameter with its description, unit and range; defaults where ``values`` has none."""
    lines = [f"{key}:\n  ros__parameters:"]
    for declaration in declared:
        unit = f" [{declaration.unit}]" if declaration.unit else ""
        lines.append(f"    # {declaration.description}{unit}; {declaration.allowed()}")
        lines.append(f"    {declaration.name}: {as_yaml((values or {}).get(declaration.name, declaration.default))}")
    return "\n".join(lines) + "\n"


def as_yaml(value: Any) -> str:
    """One value as YAML; a text in quotes."""
    style = '"' if isinstance(value, str) else None
    return str(yaml.safe_dump(value, default_style=style, width=float("inf")).splitlines()[0])
