"""For all tests."""

import pytest
from hypothesis import settings

from straightcomp_ros.launcher import Graph

pytest_plugins = ["repeats", "pytester"]

# A machine that others use too stands still for half a second now and then: an example is not wrong for being late.
settings.register_profile("shared machine", deadline=None)
settings.load_profile("shared machine")


@pytest.fixture(autouse=True)
def only_live_tests_start_nodes(request, monkeypatch):
    """A test without the mark ``live`` runs beside others and is not repeated: nothing in it must be in time."""
    if request.node.get_closest_marker("live") is None and "single" not in request.fixturenames:

        def refuse(self, name, *_, **__):
            raise AssertionError(f"this test starts the node '{name}': it needs the mark 'live'")

        monkeypatch.setattr(Graph, "start", refuse)
