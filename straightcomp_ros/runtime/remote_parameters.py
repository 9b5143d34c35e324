"""Collects the parameters of other nodes when these appear."""

from collections.abc import Sequence

import yaml
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

_ASK_EVERY_S = 0.25


class RemoteParameters:
    """Asks each of the nodes ``names`` in this node's namespace once, when it is available, for all its parameters.

    Attributes:
        values: the parameters by node and dotted name.
    """

    def __init__(self, node: Node, names: Sequence[str]) -> None:
        self.values: dict[str, dict[str, object]] = {}
        self._count = len(names)
        self._waiting = {name: AsyncParameterClient(node, name) for name in names}
        self._timer = node.create_timer(_ASK_EVERY_S, self._ask)

    def _ask(self) -> None:
        for name in [name for name, client in self._waiting.items() if client.services_are_ready()]:
            self._collect(name, self._waiting.pop(name))
        if not self._waiting:
            self._timer.cancel()

    def _collect(self, node: str, client: AsyncParameterClient) -> None:
        def listed(future: Future) -> None:
            names = list(future.result().result.names)

            def got(answer: Future) -> None:
                self.values[node] = dict(
                    zip(names, map(parameter_value_to_python, answer.result().values), strict=True)
                )

            client.get_parameters(names).add_done_callback(got)

        client.list_parameters([], 10).add_done_callback(listed)

    @property
    def complete(self) -> bool:
        """Whether all nodes have answered."""
        return len(self.values) == self._count

    def as_yaml(self) -> str:
        """The collected parameters, in the form of a ROS 2 parameter file."""
        return yaml.safe_dump(
            {name: {"ros__parameters": values} for name, values in self.values.items()}, sort_keys=False
        )
