"""Parameters of the graphs that tests start."""

from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS
from straightcomp_ros.parameters.parameter_file import shipped_parameters

FORGIVING = {
    "simulated.command_timeout": 1.0,
    "simulated.sample_memory": 1.0,
    "watch.y_limit": 0.1,
    "watch.frozen_current": 100.0,
}
"""A driver that goes on after a stall of this machine, even where it took the platform to its stop."""
# A test's own process is slow to answer at times; the timeout under test has a test of its own.
PATIENT = {**FORGIVING, "stage.rate": 200, "simulated.command_timeout": 0.5}


def loop_parameters():
    """Of the nodes in `IN_THE_LOOP`, for a graph that forgives a stall."""
    return {"driver": dict(FORGIVING), "feedforward": {}, "controller": {"sample_timeout": 30.0}}


def short_parameters():
    """The shipped parameters with a cycle of some 3.6 s over 100 mm, on a machine that forgives a stall."""
    values = shipped_parameters()
    values["stage"].update({"motion.stroke": 0.1, "motion.settle": 0.5, "motion.pause": 0.1, "motion.start": 0.0})
    values["driver"].update(FORGIVING)
    return values


def without_priority(values):
    """The parameters with nodes that take no other program's CPU."""
    for node in NODE_PARAMETERS:
        values[node]["realtime.priority"] = 0
    values["driver"]["realtime.exclusive"] = False
    return values


def of_node(values, node):
    """The parameters of one node, with the stage's."""
    stage = {} if node == "logger" else {f"stage.{name}": value for name, value in values["stage"].items()}
    return {**stage, **values[node]}
