"""Runs jobs of some milliseconds in a thread of their own, so that the control loop misses no cycle."""

import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from rclpy.node import Node

_SWITCH_INTERVAL_S = 1e-4
"""Longest wait of the loop for the interpreter lock while the other thread computes. Python's default of 5 ms is ten
sampling periods."""


T = TypeVar("T")


def awaited(job: Callable[[], T], meanwhile: Callable[[], object]) -> T:
    """What ``job`` returns or raises, done once in a thread that ends with it; scheduling as of `BesideTheLoop`.

    ``meanwhile`` is called again and again until it is done.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    with ThreadPoolExecutor(max_workers=1) as thread:
        done = thread.submit(job)
        while not done.done():
            meanwhile()
        return done.result()


class BesideTheLoop:
    """Runs jobs one after the other in the order of submission; logs those that fail.

    The thread is started by the first job, in the loop's thread, so it inherits the loop's scheduling. With a lower
    priority it could be preempted while it holds the interpreter lock, and would block the loop.
    """

    def __init__(self, node: Node) -> None:
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        self._node = node
        self._thread = ThreadPoolExecutor(max_workers=1)

    def run(self, job: Callable[[], None]) -> None:
        """Queue ``job`` and return at once."""
        self._thread.submit(job).add_done_callback(self._report)

    def close(self) -> None:
        """Wait for all jobs."""
        self._thread.shutdown(wait=True)

    def _report(self, done: Future[None]) -> None:
        error = done.exception()
        if error is not None:
            self._node.get_logger().error(f"a job beside the loop failed: {error!r}")
