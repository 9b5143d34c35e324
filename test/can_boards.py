"""Boards that the tests of CAN share."""

from pathlib import Path

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()
PERIOD = STAGE.period_ns
START = 10**18
FOREIGN_FILE = share_path("config/board_motorola.yaml")
"""The amplifier's state comes in frames of their own, on pages in turn, and there is no heartbeat."""
SPLIT_FILE = Path(__file__).parent / "hardware" / "can" / "split.yaml"
"""A message for each axis; the host sends switches and current in two."""
BARE_FILE = SPLIT_FILE.with_name("bare.yaml")


def board_of(file, **changes):
    """The driver's parameters `can` of a stage file, with others by their name; "/" stands for a dot."""
    values = shipped_parameters(stage=str(file))
    values["driver"] |= {"hardware": "can"} | {f"can.{name.replace('/', '.')}": to for name, to in changes.items()}
    return node_parameters("driver", values).can


CLASSIC, FD = (CanParameters(fd=fd, simulated_stage=True) for fd in (False, True))
FOREIGN, SPLIT, BARE = (board_of(file, simulated_stage=True) for file in (FOREIGN_FILE, SPLIT_FILE, BARE_FILE))
