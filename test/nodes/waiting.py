"""Waiting for what a node prints."""

import time

import pytest

from straightcomp_ros.launcher import Graph


def wait_for_line(graph: Graph, node: str, text: str, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if text in graph.log(node).read_text():
            return
        time.sleep(0.05)
    pytest.fail(f"{node} never printed {text!r}; it printed: {graph.log(node).read_text()}")
