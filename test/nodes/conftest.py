import os
import random

import pytest

from straightcomp_ros.cell.launcher import Graph, ros_available
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS
from straightcomp_ros.parameters.parameter_file import shipped_parameters

if not ros_available():
    pytest.skip("rclpy is not there: these tests need a sourced Jazzy or its wheels", allow_module_level=True)


@pytest.fixture(autouse=True)
def own_domain(monkeypatch):
    """Each test talks on a domain of its own, on this machine only; tests beside each other on different ones."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    # The domains above are left to whoever measures beside the tests.
    domains = range(1 + worker, 92, workers)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(random.SystemRandom().choice(domains)))
    monkeypatch.setenv("RCUTILS_LOGGING_BUFFERED_STREAM", "0")


@pytest.fixture(autouse=True)
def untraced_nodes(request, monkeypatch):
    """Nodes that keep time against each other run without coverage, which makes each step two or three times longer."""
    if request.node.get_closest_marker("keeps_time") or request.node.get_closest_marker("untraced"):
        monkeypatch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)


@pytest.fixture
def graph(tmp_path):
    """Starts nodes; who uses it is a live test."""
    with Graph(tmp_path / "logs", dict(os.environ)) as graph:
        yield graph


@pytest.fixture
def single(tmp_path):
    """Starts one node, of which no more is asked than how it comes up and how it ends: that may take its time, so other
    tests may run beside it."""
    with Graph(tmp_path / "logs", dict(os.environ)) as graph:
        yield graph


FORGIVING = {
    "simulated.command_timeout": 1.0,
    "simulated.sample_memory": 1.0,
    "watch.y_limit": 0.1,
    "watch.frozen_current": 100.0,
}
"""A driver that goes on after a stall of this machine, even where it took the platform to its stop."""


@pytest.fixture
def forgiving():
    return dict(FORGIVING)


@pytest.fixture
def short_cycle(request):
    """The shipped parameters with a cycle of some 3.6 s over 100 mm, on a machine that forgives a stall."""
    values = shipped_parameters()
    values["stage"].update({"motion.stroke": 0.1, "motion.settle": 0.5, "motion.pause": 0.1, "motion.start": 0.0})
    values["driver"].update(FORGIVING)
    values["controller"]["trigger"] = request.config.getoption("trigger")
    if request.node.get_closest_marker("live") is None:
        # Other tests run beside it: no node takes their CPU.
        for node in NODE_PARAMETERS:
            values[node]["realtime.priority"] = 0
        values["driver"]["realtime.exclusive"] = False
    return values


@pytest.fixture
def in_lockstep(short_cycle):
    """A short cycle of a graph that waits for each answer: nothing in it can be late, so other tests may run beside."""
    short_cycle["controller"]["trigger"] = "lockstep"
    short_cycle["driver"]["lockstep"] = True
    short_cycle["stage"]["drive.delay"] = 0.5
    # Both directions and a turn: a difference of one bit would grow from the first sample on.
    short_cycle["stage"].update({"motion.stroke": 0.04, "motion.settle": 0.3})
    return short_cycle
