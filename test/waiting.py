"""Waiting for what a node prints or does."""

import time
from collections.abc import Callable

import pytest

from straightcomp_ros.cell.launcher import Graph


def wait_for_line(graph: Graph, node: str, text: str) -> None:
    end = time.monotonic() + 120.0
    while time.monotonic() < end:
        if text in graph.log(node).read_text():
            return
        time.sleep(0.05)
    pytest.fail(f"{node} never printed {text!r}; it printed: {graph.log(node).read_text()}")


def comes_true(condition: Callable[[], bool], seconds: float = 30.0) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()
