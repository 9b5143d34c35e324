"""One declaration per parameter: default, unit, range and description are in a dataclass field.

The validation of every parameter set, the descriptors that nodes declare to ROS 2, and the reference documentation all
come from these declarations. A parameter set is a frozen dataclass; a field that is itself a parameter set is a group,
addressed with a dot: ``plant.actuator.turns``.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import typing
from collections.abc import Iterable, Mapping
from functools import cache, partial
from numbers import Integral, Real
from typing import Any, TypeVar

T = TypeVar("T")


class ParameterError(ValueError):
    """A parameter is unknown, of the wrong type or out of its range; the message names all three."""


_GROUP = "{group}"


class RefusedParameter(ParameterError):
    """Raised by the ``__post_init__`` of a set for its parameter ``name``, which does not fit the others.

    ``text`` has value, reason and what is allowed, and refers to other parameters of the set as ``{group}name``. The
    set does not know the name of its group in a node; :func:`from_mapping` completes the parameter's name.
    """

    def __init__(self, name: str, text: str, group: str = "") -> None:
        super().__init__(f"parameter '{group}{name}': {text.replace(_GROUP, group)}")
        self.name, self.text = name, text


@dataclasses.dataclass(frozen=True)
class Declaration:
    """Declaration of one parameter; ``name`` is the dotted name, ``kind`` one of bool, int, float, str."""

    name: str
    kind: type
    default: Any
    description: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    exclusive_minimum: bool = False
    choices: tuple[str, ...] = ()

    def allowed(self) -> str:
        """The allowed values in words, for messages and the documentation."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.kind is bool:
            return "true or false"
        bounds = []
        if self.minimum is not None:
            bounds.append(f"{'>' if self.exclusive_minimum else '>='} {self.minimum:g}")
        if self.maximum is not None:
            bounds.append(f"<= {self.maximum:g}")
        return " and ".join(bounds) or {float: "a finite number", int: "an integer", str: "a text"}[self.kind]

    def check(self, value: Any) -> Any:
        """Return ``value`` as ``kind`` (an integer is accepted as a float, NumPy's numbers too), or raise
        ParameterError."""
        if not isinstance(value, bool) and isinstance(value, _NUMBERS.get(self.kind, ())):
            value = self.kind(value)
        if why := self._wrong(value):
            unit = f" {self.unit}" if self.unit else ""
            raise ParameterError(f"parameter '{self.name}': {value!r}{unit} {why}; allowed: {self.allowed()}{unit}")
        return value

    def _wrong(self, value: Any) -> str:
        kind = type(value)
        if kind is not self.kind:
            return f"is not {_KIND_WORDS[self.kind]}"
        if self.choices and value not in self.choices:
            return "is not known"
        if self.kind is str:
            return "has control characters" if _CONTROL.search(value) else ""
        if not math.isfinite(value):
            return "is not finite"
        low, high = self.minimum, self.maximum
        if low is not None and (value < low or (self.exclusive_minimum and value == low)):
            return "is too small"
        return "is too large" if high is not None and value > high else ""


_NUMBERS: Mapping[type, type] = {float: Real, int: Integral}
_KIND_WORDS = {bool: "a truth value", int: "an integer", float: "a number", str: "a text"}
_CONTROL = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""No file is called so, and a terminal would obey it."""
_ALLOWED = re.compile(r"([\[(])(\S+), (\S+)[\])](?: (.+))?")


def parameter(default: Any, description: str, allowed: str = "(-inf, inf)", *, choices: tuple[str, ...] = ()) -> Any:
    """Declare a field. ``allowed`` is its range and its unit, e.g. ``"(0, 60] s"``: more than 0 and at most 60 s."""
    parts = _ALLOWED.fullmatch(allowed)
    if parts is None:
        raise ValueError(f"allowed {allowed!r} is not an interval with a unit, such as '[0, 60] s'")
    low, high = float(parts[2]), float(parts[3])
    return dataclasses.field(
        default=default,
        metadata={
            "description": description,
            "unit": parts[4] or "",
            "minimum": low if math.isfinite(low) else None,
            "exclusive_minimum": parts[1] == "(",
            "maximum": high if math.isfinite(high) else None,
            "choices": choices,
        },
    )


def group(parameter_set: type[T], about: str = "", **defaults: Any) -> T:
    """Declare a field that holds another parameter set, with other ``defaults`` for some of its fields.

    Each description in the set begins with ``about``: `ros2 param describe` shows one parameter without its group.
    """
    metadata = {"about": about, "defaults": defaults}
    return dataclasses.field(default_factory=partial(parameter_set, **defaults), metadata=metadata)


@cache
def _field_types(parameter_set: type) -> dict[str, Any]:
    return typing.get_type_hints(parameter_set)


@cache
def declarations(parameter_set: type, prefix: str = "", about: str = "") -> tuple[Declaration, ...]:
    """All parameters of a set and its groups, in the order of declaration; ``about`` describes the set's own group."""
    found = list[Declaration]()
    for field in dataclasses.fields(parameter_set):
        kind = _field_types(parameter_set)[field.name]
        if dataclasses.is_dataclass(kind):
            start = f"{prefix}{field.name}."
            for declaration in declarations(typing.cast(type, kind), start, field.metadata["about"] or about):
                default = field.metadata["defaults"].get(declaration.name[len(start) :], declaration.default)
                found.append(dataclasses.replace(declaration, default=default))
        else:
            one = Declaration(name=prefix + field.name, kind=kind, default=field.default, **field.metadata)
            found.append(dataclasses.replace(one, description=f"{about}: {one.description}") if about else one)
    return tuple(found)


_MANY = 20
"""Names; of more, a sentence lists the groups."""


def instead(name: str, known: Iterable[str]) -> str:
    """End of the sentence that refuses a name: the nearest of the ``known`` ones, or all of them."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    if len(names) > _MANY:
        names = list(dict.fromkeys(re.sub(r"\..*", ".…", one) for one in names))
    return f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(names) or 'none'}"


def from_mapping(parameter_set: type[T], values: Mapping[str, Any]) -> T:
    """Build a validated parameter set from dotted names; other parameters keep their defaults.

    Raises:
        ParameterError: a name is unknown (the nearest known one is suggested), or a value is refused.
    """
    known = {declaration.name: declaration for declaration in declarations(typing.cast(type, parameter_set))}
    for name in values:
        if name not in known:
            raise ParameterError(f"parameter '{name}' is unknown{instead(name, known)}")
    checked = {name: declaration.check(values.get(name, declaration.default)) for name, declaration in known.items()}
    return _build(parameter_set, checked, "")


def _build(parameter_set: type[T], checked: Mapping[str, Any], prefix: str) -> T:
    arguments: dict[str, Any] = {}
    kinds = _field_types(typing.cast(type, parameter_set))
    for field in dataclasses.fields(parameter_set):  # type: ignore[arg-type]
        kind = kinds[field.name]
        if dataclasses.is_dataclass(kind):
            arguments[field.name] = _build(typing.cast(type, kind), checked, f"{prefix}{field.name}.")
        else:
            arguments[field.name] = checked[prefix + field.name]
    try:
        return parameter_set(**arguments)
    except RefusedParameter as error:
        raise RefusedParameter(error.name, error.text, prefix) from None


def to_mapping(parameters: Any, prefix: str = "") -> dict[str, Any]:
    """The values of a parameter set by dotted name: the inverse of :func:`from_mapping`."""
    values: dict[str, Any] = {}
    for field in dataclasses.fields(parameters):
        value = getattr(parameters, field.name)
        if dataclasses.is_dataclass(value):
            values.update(to_mapping(value, f"{prefix}{field.name}."))
        else:
            values[prefix + field.name] = value
    return values


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Convert nested mappings, as in a YAML parameter file, to dotted names; ParameterError for one given twice."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        # An empty mapping stands in place of a value, which is then refused.
        inside = isinstance(value, Mapping) and value
        given = flatten(value, f"{prefix}{key}.") if inside else {f"{prefix}{key}": value}
        twice = next(iter(given.keys() & flat.keys()), None)
        if twice is not None:
            raise ParameterError(f"parameter '{twice}' is given twice")
        flat |= given
    return flat


def under(prefix: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Those of a node's ``values`` in a group such as ``stage.guide.``, by their names in it."""
    return {name.removeprefix(prefix): value for name, value in values.items() if name.startswith(prefix)}


_ROS_OWN = ("use_sim_time", "start_type_description_service")


def belongs_to_ros(name: str) -> bool:
    """Whether ROS itself declares a parameter of this name on every node."""
    return name in _ROS_OWN or name.startswith("qos_overrides.")
