"""Reads the ROS 2 parameter file that sets the parameters of all nodes; offline runs read the same file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from straightcomp_ros.configuration.node_parameters import NODE_PARAMETERS
from straightcomp_ros.settings.declaration import ParameterError, flatten


def read_parameter_file(path: str | Path) -> dict[str, dict[str, Any]]:
    """Values of a ROS 2 parameter file by node and dotted name, with a key for each node of this package.

    Raises:
        ParameterError: the file cannot be read, is not YAML, is empty, or does not have the layout of a parameter file.
    """
    try:
        tree = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ParameterError(f"parameter file {path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ParameterError(f"parameter file {path}: byte {error.start} is not UTF-8; name a YAML file") from error
    except yaml.YAMLError as error:
        raise ParameterError(f"parameter file {path}: no YAML: {' '.join(str(error).split())}") from error
    return _read_tree(tree, f"parameter file {path}")


def _read_tree(tree: Any, source: str) -> dict[str, dict[str, Any]]:
    """Values in the content of a parameter file; ``source`` names the file in messages.

    A key is a node's name, with or without a namespace before it (``/**/driver``, ``driver``).

    Raises:
        ParameterError: another layout, or an unknown node.
    """
    values: dict[str, dict[str, Any]] = {name: {} for name in NODE_PARAMETERS}
    if not isinstance(tree, Mapping):
        raise ParameterError(f"{source}: has no 'NODE: ros__parameters:' level")
    for key, section in tree.items():
        name = str(key).rsplit("/", 1)[-1]
        if name not in values:
            raise ParameterError(f"{source}: node '{key}' is unknown; known: {', '.join(values)}")
        if not isinstance(section, Mapping) or not isinstance(section.get("ros__parameters"), Mapping):
            raise ParameterError(f"{source}: node '{key}' has no 'ros__parameters:'")
        values[name].update(flatten(section["ros__parameters"]))
    return values
