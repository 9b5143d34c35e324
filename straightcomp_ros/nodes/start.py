"""Starts the nodes. Their modules import ROS as they are loaded: here, so that one sentence says what is missing."""

import sys
from functools import partial
from importlib import import_module

from straightcomp_ros.cell.launcher import without_ros


def _start(node: str, folder: str = "nodes") -> int:
    try:
        module = import_module(f"straightcomp_ros.{folder}.{node}_node")
    except ImportError as error:
        sentence = without_ros(error)
        if not sentence:
            raise
        print(f"{node}: {sentence}", file=sys.stderr)
        return 2
    return int(module.main())


driver_node, feedforward_node, controller_node, servo_node, logger_node, cell_node, player_node, opcua_node = (
    partial(_start, node)
    for node in ("driver", "feedforward", "controller", "servo", "logger", "cell", "player", "opcua")
)
commissioning_node = partial(_start, "commissioning", "tuning.graph")
