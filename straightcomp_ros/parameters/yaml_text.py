"""YAML that anyone may have written, read within a bounded time and memory or refused in one sentence; and written.

Numbers are what YAML 1.2 and rcl take for numbers: ``5e-8`` is one, ``190:20:30`` and ``1_000`` are texts, and so are
dates. A leading 0 is octal, as for rcl, which reads the same files for nodes.
"""

from __future__ import annotations

import codecs
import errno
import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml
from numpy.typing import NDArray

from straightcomp_ros.parameters.declaration import ParameterError, flatten

MOST_BYTES = 4 << 20
MOST_NODES = 50_000
"""Largest number of values and keys, each counted as often as aliases repeat it: the largest parameter file has 300."""
_DEEPEST = 50
PARAMETERS = "ros__parameters"
_TAG = "tag:yaml.org,2002:"
_CORE = {"!", *(_TAG + kind for kind in ("null", "bool", "int", "float", "str", "seq", "map"))}
_FAST: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class YamlError(ValueError):
    """The text is no YAML, or more than is read; the message says where and why."""


def load_yaml(source: Path | str | bytes, most_bytes: int = MOST_BYTES, most_nodes: int = MOST_NODES) -> Any:
    """The content of a YAML file (a path) or text.

    Raises:
        YamlError: it is no YAML in UTF-8, larger than ``most_bytes`` or ``most_nodes`` values and keys, nested more
            than 50 levels deep, contains itself, gives a key twice, or has a type of its own (``!!python/object``).
        OSError: the file cannot be read.
    """
    if isinstance(source, Path):
        source = _begin(source, most_bytes + 1)
    try:
        text = source if isinstance(source, str) else source.decode("utf-8-sig")
        if len(source) > most_bytes:
            raise YamlError(f"is larger than {most_bytes / (1 << 20):g} MB")
        _check(text, most_nodes)
        return yaml.load(text, Loader=_Loader)
    except UnicodeDecodeError as error:
        raise YamlError(f"byte {error.start} is not UTF-8") from error
    except yaml.YAMLError as error:
        raise YamlError("no YAML: " + " ".join(str(error).replace(' in "<unicode string>",', " in").split())) from error
    except (LookupError, ValueError) as error:
        if isinstance(error, YamlError):
            raise
        # The text behind a tag such as !!bool is none.
        raise YamlError(f"no YAML: {error}") from error


def _begin(path: Path, size: int) -> bytes:
    with path.open("rb") as file:
        return file.read(size)


def node_sections(source: Path | bytes) -> list[tuple[str, dict[str, Any]]]:
    """Of a ROS 2 parameter file, or its content, the key of each section and its parameters by dotted name; of nested
    keys (``/**:`` above ``driver:``) all, with ``/`` between them.

    Raises:
        ParameterError: it is not YAML, has another layout, or gives a parameter twice.
        OSError: the file cannot be read.
    """
    try:
        tree = load_yaml(source)
    except YamlError as error:
        raise ParameterError(str(error)) from error
    if not isinstance(tree, Mapping):
        raise ParameterError("has no 'NODE: ros__parameters:' level")
    return list(_sections(tree, ""))


def _sections(tree: Mapping[Any, Any], above: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for key, inside in tree.items():
        name = f"{above}{key}"
        # An empty one has neither parameters nor another key.
        if not (isinstance(inside, Mapping) and isinstance(inside.get(PARAMETERS, inside or None), Mapping)):
            raise ParameterError(f"node '{name}' has no '{PARAMETERS}:'")
        if PARAMETERS in inside:
            yield name, flatten(inside[PARAMETERS])
        yield from _sections({one: below for one, below in inside.items() if one != PARAMETERS}, f"{name}/")


def bounded_bytes(path: Path, most_mb: int = 256) -> bytes:
    """The content of a file that a user names; OSError where it cannot be read, or does not end within ``most_mb`` MB:
    a device has no end, and a pipe waits for its other end."""
    if path.is_fifo():
        raise OSError(errno.EINVAL, "is a pipe; name a file")
    content = _begin(path, (most_mb << 20) + 1)
    if len(content) > most_mb << 20:
        raise OSError(errno.EFBIG, f"is larger than {most_mb} MB")
    return content


def marked_encoding(content: bytes) -> str | None:
    """The encoding by the byte order mark that spreadsheets and Windows put in front; None without one."""
    marks = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
    return next((encoding for mark, encoding in marks.items() if content.startswith(mark)), None)


def bounded_lines(path: Path, where: str) -> list[str]:
    """The lines of such a file; ParameterError, which begins with ``where``, if it cannot be read, or is no UTF-8."""
    try:
        return bounded_bytes(path).decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError(f"{where}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def number_rows(
    lines: Iterable[str], where: str, largest: Mapping[str, float], *, header: bool = True, blank: Collection[str] = ()
) -> NDArray[np.float64]:
    """Numbers (rows, columns) of lines with commas between them, without empty lines and what is behind a ``#``.

    ``largest`` has the magnitude that each column may have; an empty cell of one that may be ``blank`` is NaN.
    ParameterError, which begins with ``where``: the ``header`` with the columns' names is missing, or a row is not so.
    """
    texts = [(number, text) for number, line in enumerate(lines, 1) if (text := line.partition("#")[0].strip())]
    if header:
        first = texts.pop(0)[1] if texts else ""
        if [name.strip() for name in first.split(",")] != list(largest):
            raise ParameterError(f"{where}: header {first[:200]!r}; allowed: {','.join(largest)!r}")
    rows = []
    for number, text in texts:
        cells = [cell.strip() for cell in text.split(",")]
        rows.append([number_or_nan(cell) for cell in cells])
        for name, cell, value in zip_longest(largest, cells, rows[-1]):
            if cell is None or not (abs(value) <= largest.get(name, -1.0) or (name in blank and not cell)):
                allowed = ", ".join(f"{one} within ±{most:g}" for one, most in largest.items())
                raise ParameterError(f"{where}, line {number}: {text[:200]!r}; allowed: {allowed}")
    return np.array(rows, np.float64).reshape(-1, len(largest))


def number_or_nan(value: Any) -> float:
    """``value``, a text or what YAML made of it, as a number; NaN if it is none."""
    try:
        return math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        return math.nan


def _check(text: str, most_nodes: int) -> None:
    """Refuse what would not end or not fit, before anything is built."""
    sizes: dict[str, int] = {}
    opened: list[tuple[str | None, int]] = []
    nodes = 0
    for event in yaml.parse(text, Loader=_FAST):
        where = f"line {event.start_mark.line + 1}"
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = opened.pop()
            if anchor:
                sizes[anchor] = nodes - before
            continue
        if not isinstance(event, yaml.NodeEvent):
            continue
        if isinstance(event, yaml.AliasEvent):
            if any(event.anchor == anchor for anchor, _ in opened):
                raise YamlError(f"{where}: '*{event.anchor}' contains itself")
            nodes += sizes.get(event.anchor, 1)
        else:
            if event.tag is not None and event.tag not in _CORE:
                raise YamlError(f"{where}: type {event.tag!r} is not read; allowed: numbers, texts, lists, mappings")
            nodes += 1
            if isinstance(event, yaml.CollectionStartEvent):
                opened.append((event.anchor, nodes - 1))
            elif event.anchor:
                sizes[event.anchor] = 1
        if len(opened) > _DEEPEST:
            raise YamlError(f"{where}: is nested more than {_DEEPEST} levels deep")
        if nodes > most_nodes:
            raise YamlError(f"{where}: has more than {most_nodes} values and keys")


class _Loader(_FAST):  # type: ignore[misc]  # types of PyYAML may be installed or not
    """PyYAML's safe loader, which would let the last of two equal keys win, and knows YAML 1.1's numbers and dates."""

    yaml_implicit_resolvers: ClassVar[dict[str, list[tuple[str, re.Pattern[str]]]]] = {}

    def flatten_mapping(self, node: Any) -> None:
        # Once each: the mapping that another merges stays with what it has merged itself.
        if getattr(node, "flat", False):
            return
        node.flat, lines = True, dict[Any, int]()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                continue
            key = key_node.value if key_node.tag == f"{_TAG}merge" else self.construct_object(key_node)
            line = key_node.start_mark.line + 1
            if key in lines:
                raise YamlError(f"line {line}: key '{key}' is given twice, first in line {lines[key]}")
            lines[key] = line
        super().flatten_mapping(node)


for _kind in ("bool", "null", "merge"):
    for _first, _resolvers in _FAST.yaml_implicit_resolvers.items():
        for _tag, _pattern in _resolvers:
            if _tag == _TAG + _kind:
                _Loader.yaml_implicit_resolvers.setdefault(_first, []).append((_tag, _pattern))
# A number of more digits than an integer has is a floating-point number, as for rcl.
_INT = r"[-+]?(0x[0-9a-fA-F]{1,16}|0[0-7]{0,21}|[1-9][0-9]{0,18})"
_FLOAT = r"[-+]?((\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|\.(inf|Inf|INF))|\.(nan|NaN|NAN)"
# In place of a value it is a text, as any other.
_Loader.add_constructor(_TAG + "merge", _FAST.construct_yaml_str)
_Loader.add_implicit_resolver(_TAG + "int", re.compile(f"(?:{_INT})$"), list("-+0123456789"))
_Loader.add_implicit_resolver(_TAG + "float", re.compile(f"(?:{_FLOAT})$"), list("-+.0123456789"))


class _Dumper(yaml.SafeDumper):  # type: ignore[misc, unused-ignore]
    """Puts in quotes each text that PyYAML, rcl or :func:`load_yaml` would take for something else."""


_Dumper.add_implicit_resolver(_TAG + "bool", re.compile("^[yYnN]$"), list("yYnN"))
_Dumper.add_implicit_resolver(_TAG + "float", re.compile(f"(?:{_FLOAT})$"), list("-+.0123456789"))
_Dumper.add_multi_representer(np.generic, lambda dumper, number: dumper.represent_data(number.item()))


def dump_yaml(tree: Any) -> str:
    """The YAML text of plain values, NumPy's numbers among them, in their order."""
    return str(yaml.dump(tree, Dumper=_Dumper, sort_keys=False))
