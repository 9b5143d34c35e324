"""A section of a ROS 2 parameter file in which a comment explains each parameter."""

from collections.abc import Iterable, Mapping
from typing import Any

import yaml

from straightcomp_ros.parameters.declaration import Declaration


def commented(key: str, declared: Iterable[Declaration], values: Mapping[str, Any] | None = None) -> str:
    """The section ``key``: each parameter with its description, unit and range; defaults where ``values`` has none."""
    lines = [f"{key}:\n  ros__parameters:"]
    for declaration in declared:
        unit = f" [{declaration.unit}]" if declaration.unit else ""
        lines.append(f"    # {declaration.description}{unit}; {declaration.allowed()}")
        lines.append(f"    {declaration.name}: {as_yaml((values or {}).get(declaration.name, declaration.default))}")
    return "\n".join(lines) + "\n"


def as_yaml(value: Any) -> str:
    """One value as YAML 1.1, which takes 1e-07 for a text: a float needs its point."""
    if isinstance(value, float) and "e" in repr(value) and "." not in repr(value):
        return repr(value).replace("e", ".0e")
    return yaml.safe_dump(value, default_style='"' if isinstance(value, str) else None).splitlines()[0]
