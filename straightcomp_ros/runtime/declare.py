"""Declares a parameter set to ROS 2: types, ranges and descriptions come from its dataclass."""

import sys
from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from straightcomp_ros.parameters.declaration import Declaration, belongs_to_ros, declarations, from_mapping
from straightcomp_ros.parameters.node_parameters import STAGE

T = TypeVar("T")

_FIXED = ("autostart", "realtime")
"""Parameters that are used once, when the process starts."""


def declare(node: Node, parameter_set: type[T], *, changeable: bool = False) -> T:
    """Read and validate what launch file, YAML and command line gave to ``node``; declare every parameter.

    Make the node with ``automatically_declare_parameters_from_overrides=True``: otherwise it hides unknown names.
    With ``changeable`` only the parameters that are used at the start of the process are read-only.

    Raises:
        ParameterError: unknown name, wrong type or value out of range.
    """
    given = {name: value.value for name, value in node.get_parameters_by_prefix("").items() if not belongs_to_ros(name)}
    # A stage file describes the stage to all nodes; some need nothing of it.
    if STAGE not in parameter_set.__annotations__:
        described = [name for name in given if name.startswith(f"{STAGE}.")]
        for name in described:
            node.undeclare_parameter(name)
            del given[name]
    parameters = from_mapping(parameter_set, given)
    for declaration in declarations(parameter_set):
        value = declaration.check(given.get(declaration.name, declaration.default))
        if declaration.name in given:
            node.undeclare_parameter(declaration.name)
        fixed = not changeable or declaration.name.split(".")[0] in _FIXED
        # ``value`` is the given value, with an integer converted to float where the declaration says so.
        node.declare_parameter(declaration.name, value, _descriptor(declaration, fixed), ignore_override=True)
    return parameters


def _descriptor(declaration: Declaration, fixed: bool) -> ParameterDescriptor:
    unit = f" [{declaration.unit}]" if declaration.unit else ""
    descriptor = ParameterDescriptor(
        description=f"{declaration.description}{unit}",
        additional_constraints=declaration.allowed(),
        read_only=fixed,
    )
    low, high = declaration.minimum, declaration.maximum
    if declaration.kind is float and (low is not None or high is not None):
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=-sys.float_info.max if low is None else float(low),
                to_value=sys.float_info.max if high is None else float(high),
            )
        ]
    elif declaration.kind is int and (low is not None or high is not None):
        descriptor.integer_range = [
            IntegerRange(
                from_value=-(2**63) if low is None else int(low),
                to_value=2**63 - 1 if high is None else int(high),
                step=1,
            )
        ]
    return descriptor
