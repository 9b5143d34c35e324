import os
import signal

import pytest
from parameters_of_tests import short_parameters, without_priority

from straightcomp_ros.cell.launcher import Graph, free_domain, ros_available

if not ros_available():
    pytest.skip("rclpy is not there: these tests need a sourced Jazzy or its wheels", allow_module_level=True)

from participant import Participant


def a_domain():
    """A ROS domain for a test or a module; processes that run tests in parallel have different ones."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    # The domains above are left to whoever measures in parallel with the tests.
    return free_domain(range(1 + worker, 92, workers))


@pytest.fixture(autouse=True)
def own_domain(request, monkeypatch):
    """Each test talks on a domain of its own, on this machine only, or with its module's graph."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    shared = "shared_graph" in request.fixturenames
    monkeypatch.setenv("ROS_DOMAIN_ID", request.getfixturevalue("shared_graph").domain if shared else a_domain())
    monkeypatch.setenv("RCUTILS_LOGGING_BUFFERED_STREAM", "0")


@pytest.fixture(autouse=True)
def untraced_nodes(request, monkeypatch):
    """Nodes that keep time against each other run without coverage, which makes each step two or three times longer."""
    if request.node.get_closest_marker("keeps_time") or request.node.get_closest_marker("untraced"):
        monkeypatch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)


@pytest.fixture
def in_a_terminal():
    """The tests themselves may have been started by `nohup`, which ignores SIGHUP; so would their
    nodes."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(scope="module")
def shared_graph(tmp_path_factory):
    """One graph for the tests of a module that end none of its nodes; they have the mark ``live``."""
    domain, options = a_domain(), {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "RCUTILS_LOGGING_BUFFERED_STREAM": "0"}
    environment = {**os.environ, **options, "ROS_DOMAIN_ID": domain}
    environment.pop("COVERAGE_PROCESS_CONFIG", None)
    with Graph(tmp_path_factory.mktemp("graph") / "logs", environment) as graph:
        graph.domain = domain
        yield graph


@pytest.fixture
def single(tmp_path):
    """Starts a node that has nothing to answer in time: how it comes up, what it records, how it ends. Other tests may
    run in parallel."""
    with Graph(tmp_path / "logs", dict(os.environ)) as graph:
        yield graph


@pytest.fixture
def graph(single):
    """Starts nodes; who uses it is a live test."""
    return single


@pytest.fixture
def participant(own_domain):
    """A node of the test's own."""
    with Participant() as participant:
        yield participant


@pytest.fixture
def short_cycle(request):
    values = short_parameters()
    values["controller"]["trigger"] = request.config.getoption("trigger")
    # Beside others in parallel, if it is not live.
    return values if request.node.get_closest_marker("live") else without_priority(values)


@pytest.fixture
def in_lockstep(short_cycle):
    """A short cycle of a graph that waits for each answer: nothing in it can be late, so other tests may run in
    parallel."""
    short_cycle["controller"]["trigger"] = "lockstep"
    short_cycle["driver"]["lockstep"] = True
    short_cycle["stage"]["drive.delay"] = 0.5
    # Both directions and a turn: a difference of one bit would grow from the first sample on.
    short_cycle["stage"].update({"motion.stroke": 0.04, "motion.settle": 0.3})
    return short_cycle
