"""Collects the parameters of other nodes when these appear."""

from collections.abc import Sequence

from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

from straightcomp_ros.parameters.yaml_text import dump_yaml

_LOOK_EVERY_S = 0.25
_AGAIN_AFTER = 8
"""Looks until a node is asked again: a response is lost if the node hears of the request before it hears who asks."""


class RemoteParameters:
    """Asks each of the nodes ``names`` in this node's namespace, when it is available, for all its parameters.

    Attributes:
        values: the parameters by node and dotted name.
    """

    def __init__(self, node: Node, names: Sequence[str]) -> None:
        self.values: dict[str, dict[str, object]] = {}
        self._clients = {name: AsyncParameterClient(node, name) for name in names}
        self._looks_left = dict.fromkeys(names, 0)
        self._timer = node.create_timer(_LOOK_EVERY_S, self._look)

    def _look(self) -> None:
        for name in [name for name in self._clients if name not in self.values]:
            self._looks_left[name] -= 1
            if self._looks_left[name] < 0 and self._clients[name].services_are_ready():
                self._looks_left[name] = _AGAIN_AFTER
                self._collect(name, self._clients[name])
        if self.complete:
            self._timer.cancel()

    def _collect(self, node: str, client: AsyncParameterClient) -> None:
        def listed(future: Future) -> None:
            names = list(future.result().result.names)

            def got(answer: Future) -> None:
                values = answer.result().values
                # Not so many after a parameter was undeclared meanwhile: ask again.
                if len(values) == len(names):
                    self.values[node] = dict(zip(names, map(parameter_value_to_python, values), strict=True))

            client.get_parameters(names).add_done_callback(got)

        client.list_parameters([], 10).add_done_callback(listed)

    @property
    def complete(self) -> bool:
        """Whether all nodes have answered."""
        return len(self.values) == len(self._clients)

    def as_yaml(self) -> str:
        """The collected parameters, in the form of a ROS 2 parameter file."""
        return dump_yaml({name: {"ros__parameters": values} for name, values in self.values.items()})
