"""Writes config/straightcomp.yaml, the settings of all nodes, and config/stage_synthetic.yaml, the shipped stage."""

from pathlib import Path
from typing import Any

from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, STAGE
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.parameter_file import ALL_NODES, DEFAULT_FILE, DEFAULT_STAGE, commented
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.timing.realtime import place

FOLDER = Path(__file__).resolve().parent.parent
CHANGED: dict[str, dict[str, Any]] = {
    node: {"realtime.priority": 40, "realtime.cpus": place(node)}
    for node in ("driver", "controller", "feedforward", "logger", "cell", "opcua")
}
CHANGED["driver"] |= {"simulated.command_timeout": 0.25, "realtime.keep_awake": True, "realtime.exclusive": True}
"""Values that differ from the default; the head of the file says why."""
HEAD = """\
# Settings of all nodes of straightcomp_ros, for `--params-file` and for the launch files. What they know of the
# machine, the parameters stage.*, is in a file of its own: stage_synthetic.yaml describes the simulated stage.
# Made by scripts/make_parameter_file.py from the declarations in the code; SI units.
# Some values differ from their defaults. realtime.priority asks for real-time scheduling; where it is not permitted the
# nodes say so and run without. realtime.keep_awake halves the time that a CPU takes to wake up.
# realtime.cpus puts driver and controller on one CPU, where one wakes the other in a tenth of the time that it takes
# between two, and keeps the other nodes off it; the loop of a second stage on the same machine takes another CPU.
# realtime.exclusive keeps other programs off that CPU for as long as the driver runs.
# simulated.command_timeout is longer than the default of 5 ms: a desktop stalls for longer at times, and a simulated
# machine breaks nothing.
"""
STAGE_HEAD = """\
# The synthetic stage that is shipped: a machine as it might stand in a shop. Each fact is here once; every node takes
# what it needs. Made by scripts/make_parameter_file.py; SI units. Sections of single nodes come first: to ROS the last
# value counts, and a parameter on a command line joins those of all nodes.
"""
TRUTH = {"simulated.truth.guide": "config/guide_synthetic.csv"}
"""The survey of the shipped stage was measured with errors: its guide is another file."""


def parameter_file() -> str:
    """Text of the settings."""
    sections = [HEAD]
    for node, parameter_set in NODE_PARAMETERS.items():
        # Gains and truth belong to a stage.
        own = [one for one in declarations(parameter_set) if not one.name.startswith(f"{STAGE}.")]
        sections.append(commented(f"{ALL_NODES}/{node}", own, CHANGED.get(node, {})))
    return "\n".join(sections)


def stage_file() -> str:
    """Text of the shipped stage."""
    described = commented(ALL_NODES, declarations(StageParameters, f"{STAGE}."))
    truth = [one for one in declarations(NODE_PARAMETERS["driver"]) if one.name in TRUTH]
    return "\n".join([STAGE_HEAD, commented(f"{ALL_NODES}/driver", truth, TRUTH), described])


if __name__ == "__main__":
    write_whole(FOLDER / DEFAULT_FILE, parameter_file())
    write_whole(FOLDER / DEFAULT_STAGE, stage_file())
