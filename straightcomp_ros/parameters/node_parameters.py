"""A node's parameters from values by node, whatever gave them: files, the command line, a bag."""

from collections.abc import Iterable, Mapping
from typing import Any

from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.parameters.parameter_sets import (
    CellNodeParameters,
    CommissioningNodeParameters,
    ControllerNodeParameters,
    DriverNodeParameters,
    FeedforwardNodeParameters,
    LoggerNodeParameters,
    OpcuaNodeParameters,
    PlayerNodeParameters,
)
from straightcomp_ros.stage.former_names import present_name

NODE_PARAMETERS: Mapping[str, type] = {
    "driver": DriverNodeParameters,
    "feedforward": FeedforwardNodeParameters,
    "controller": ControllerNodeParameters,
    "logger": LoggerNodeParameters,
    "cell": CellNodeParameters,
    "player": PlayerNodeParameters,
    "opcua": OpcuaNodeParameters,
    "commissioning": CommissioningNodeParameters,
}
"""Parameter set of each node, by the node's name."""

STAGE = "stage"
"""Key of the stage's description in values by node, beside the nodes' names."""
Values = Mapping[str, Mapping[str, Any]]
"""Parameters by node and dotted name; the description of the stage under :data:`STAGE`."""


def _described(name: str, values: Values) -> dict[str, Any]:
    """The description's parameters as the node ``name`` calls them; none for a node that has no description."""
    if STAGE not in NODE_PARAMETERS[name].__annotations__:
        return {}
    return {f"{STAGE}.{key}": value for key, value in values.get(STAGE, {}).items()}


def by_node(values: Values) -> dict[str, dict[str, Any]]:
    """Values of each node alone, the stage's description included, as a running node has them."""
    return {node: {**_described(node, values), **values.get(node, {})} for node in NODE_PARAMETERS if node in values}


def refuse_former_names(node: str, names: Iterable[str]) -> None:
    """Raise ParameterError for a parameter of ``node`` that has another name now."""
    for name in names:
        present = present_name(node, name)
        if present != name:
            place = ", under '/**' for all nodes" if present.startswith(f"{STAGE}.") else ""
            raise ParameterError(f"parameter '{name}' is '{present}' now{place}")


def node_parameters(name: str, values: Values) -> Any:
    """Validated parameter set of the node ``name``.

    Args:
        name: of the node.
        values: by node and dotted name; those of :data:`STAGE` hold for every node that has not its own.

    Raises:
        ParameterError: a name is unknown or a value is refused; the message also names the node.
    """
    try:
        refuse_former_names(name, values.get(name, {}))
        return from_mapping(NODE_PARAMETERS[name], {**_described(name, values), **values.get(name, {})})
    except ParameterError as error:
        # A fact of the description is no node's own.
        own = "" if str(error).startswith(f"parameter '{STAGE}.") else f"node {name}: "
        raise ParameterError(f"{own}{error}") from error
