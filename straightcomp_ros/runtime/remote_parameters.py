"""Collects the parameters of other nodes, as far as these nodes appear."""

from __future__ import annotations

from collections.abc import Sequence

import yaml
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

_ASK_EVERY_S = 0.25


class RemoteParameters:
    """Asks each node once, when it is there, for all its parameters.

    Args:
        node: asks.
        names: nodes to ask, in this node's namespace.
    """

    def __init__(self, node: Node, names: Sequence[str]) -> None:
        self._clients = {name: AsyncParameterClient(node, name) for name in names}
        self._asked: set[str] = set()
        self._values: dict[str, dict[str, object]] = {}
        self._timer = node.create_timer(_ASK_EVERY_S, self._ask)

    def _ask(self) -> None:
        for name, client in self._clients.items():
            if name not in self._asked and client.services_are_ready():
                self._asked.add(name)
                client.list_parameters([], 10).add_done_callback(lambda future, name=name: self._listed(name, future))
        if len(self._asked) == len(self._clients):
            self._timer.cancel()

    def _listed(self, name: str, future: Future) -> None:
        names = list(future.result().result.names)
        self._clients[name].get_parameters(names).add_done_callback(
            lambda answer: self._values.update(
                {name: dict(zip(names, map(parameter_value_to_python, answer.result().values), strict=True))}
            )
        )

    @property
    def complete(self) -> bool:
        """Whether all nodes have answered."""
        return len(self._values) == len(self._clients)

    @property
    def values(self) -> dict[str, dict[str, object]]:
        """What was collected, by node and dotted name."""
        return dict(self._values)

    def as_yaml(self) -> str:
        """What was collected, in the form of a ROS 2 parameter file."""
        return yaml.safe_dump(
            {name: {"ros__parameters": values} for name, values in self._values.items()}, sort_keys=False
        )
