"""A node's parameter set as ROS 2 parameters: declared from its dataclass, and changed together or not at all."""

import sys
from collections.abc import Callable
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from straightcomp_ros.parameters.declaration import (
    Declaration,
    ParameterError,
    belongs_to_ros,
    declarations,
    from_mapping,
    to_mapping,
)
from straightcomp_ros.parameters.node_parameters import STAGE
from straightcomp_ros.runtime.guarded_node import REFUSALS

T = TypeVar("T")
Prepare = Callable[[Any], Callable[[], None]]

_WIDEST: dict[Any, tuple[Any, Any]] = {
    float: (-sys.float_info.max, sys.float_info.max),
    int: (-(2**63), 2**63 - 1),
}
_FIXED = ("autostart", "realtime")
"""Parameters that are used once, when the process starts."""


def declare(node: Node, parameter_set: type[T], *, changeable: bool = False) -> T:
    """Read and validate what launch file, YAML and command line gave to ``node``; declare every parameter.

    Make the node with ``automatically_declare_parameters_from_overrides=True``: otherwise it hides unknown names.
    With ``changeable`` only the parameters that are used at the start of the process are read-only. ParameterError for
    an unknown name, a wrong type or a value out of range.
    """
    given = {name: value.value for name, value in node.get_parameters_by_prefix("").items() if not belongs_to_ros(name)}
    # A stage file describes the stage to all nodes; some need nothing of it.
    if STAGE not in parameter_set.__annotations__:
        for name in [name for name in given if name.startswith(f"{STAGE}.")]:
            node.undeclare_parameter(name)
            del given[name]
    parameters = from_mapping(parameter_set, given)
    # As they were given, but for integers where the declaration says float.
    values = to_mapping(parameters)
    for declaration in declarations(parameter_set):
        if declaration.name in given:
            node.undeclare_parameter(declaration.name)
        fixed = not changeable or declaration.name.split(".")[0] in _FIXED
        descriptor = _descriptor(declaration, fixed)
        node.declare_parameter(declaration.name, values[declaration.name], descriptor, ignore_override=True)
    return parameters


def _descriptor(declaration: Declaration, fixed: bool) -> ParameterDescriptor:
    unit = f" [{declaration.unit}]" if declaration.unit else ""
    descriptor = ParameterDescriptor(
        description=f"{declaration.description}{unit}",
        additional_constraints=declaration.allowed(),
        read_only=fixed,
    )
    kind, low, high = declaration.kind, declaration.minimum, declaration.maximum
    if kind in _WIDEST and not (low is None and high is None):
        lowest, highest = _WIDEST[kind]
        span = {"from_value": lowest if low is None else kind(low), "to_value": highest if high is None else kind(high)}
        if kind is float:
            descriptor.floating_point_range = [FloatingPointRange(**span)]
        else:
            descriptor.integer_range = [IntegerRange(**span, step=1)]
    return descriptor


class ParameterChanges:
    """Refuses what the parameter set or the component refuses; the requesting client gets the reason.

    While the node is unconfigured any parameter may change: the next configuration reads it. In other states only the
    parameters that the set names in ``dynamic`` may change.

    Attributes:
        prepare: the component's, which decides on changes; None while the node is unconfigured.
    """

    def __init__(self, node: Node, parameter_set: type) -> None:
        self._node, self._parameter_set = node, parameter_set
        self._names = [declaration.name for declaration in declarations(parameter_set)]
        self.prepare: Prepare | None = None
        self._take_over: Callable[[], None] | None = None
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._changed)

    def parameters(self) -> Any:
        """The parameter set with the current values; ParameterError if they contradict each other."""
        return from_mapping(self._parameter_set, self._values())

    def _values(self) -> dict[str, Any]:
        return {name: self._node.get_parameter(name).value for name in self._names}

    def _check(self, asked: list[Parameter]) -> SetParametersResult:
        self._take_over = None
        values = self._values()
        changed = {p.name: p.value for p in asked if not belongs_to_ros(p.name) and values.get(p.name) != p.value}
        try:
            parameters = from_mapping(self._parameter_set, {**values, **changed})
            if changed and self.prepare is not None:
                self._refuse_fixed(changed)
                self._take_over = self.prepare(parameters)
        except REFUSALS as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _refuse_fixed(self, changed: dict[str, Any]) -> None:
        dynamic = self._parameter_set.dynamic  # type: ignore[attr-defined]
        for name in changed:
            if not any(name == one or name.startswith(f"{one}.") for one in dynamic):
                raise ParameterError(
                    f"parameter '{name}' is fixed while the node is configured; clean the node up first, "
                    f"or change one of: {', '.join(dynamic) or 'none'}"
                )

    def _changed(self, _: list[Parameter]) -> None:
        take_over, self._take_over = self._take_over, None
        if take_over is not None:
            take_over()
