"""Parameter changes of a running managed node: checked together, and applied together or not at all."""

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from straightcomp_ros.parameters.declaration import ParameterError, belongs_to_ros, declarations, from_mapping

Prepare = Callable[[Any], Callable[[], None]]


class ParameterChanges:
    """Refuses what the parameter set or the component refuses; the requesting client gets the reason.

    While the node is unconfigured any parameter may change: the next configuration reads it. In other states only the
    parameters that the set names in ``dynamic`` may change.

    Args:
        node: its parameters have been declared.
        parameter_set: of the node.
        refusals: exceptions by which the component refuses values.
    """

    def __init__(self, node: Node, parameter_set: type, refusals: tuple[type[Exception], ...]) -> None:
        self._node, self._parameter_set, self._refusals = node, parameter_set, refusals
        self._names = [declaration.name for declaration in declarations(parameter_set)]
        self._prepare: Prepare | None = None
        self._take_over: Callable[[], None] | None = None
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._changed)

    def parameters(self) -> Any:
        """The parameter set with the current values.

        Raises:
            ParameterError: the values contradict each other.
        """
        return from_mapping(self._parameter_set, self._values())

    def follow(self, prepare: Prepare | None) -> None:
        """Let the component's ``prepare`` decide on changes from now on; None while the node is unconfigured."""
        self._prepare = prepare

    def _values(self) -> dict[str, Any]:
        return {name: self._node.get_parameter(name).value for name in self._names}

    def _check(self, asked: list[Parameter]) -> SetParametersResult:
        self._take_over = None
        values = self._values()
        changed = {p.name: p.value for p in asked if not belongs_to_ros(p.name) and values.get(p.name) != p.value}
        try:
            parameters = from_mapping(self._parameter_set, {**values, **changed})
            if changed and self._prepare is not None:
                self._refuse_fixed(changed)
                self._take_over = self._prepare(parameters)
        except self._refusals as error:
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
