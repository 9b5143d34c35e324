"""Work of some milliseconds, done on a thread of its own, so that the control loop misses no cycle."""

import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from rclpy.node import Node

_SWITCH_INTERVAL_S = 1e-4
"""How long the loop may have to wait for the interpreter while the other thread computes; Python's own 5 ms are ten
sampling periods."""


class BesideTheLoop:
    """Runs jobs one after the other, in the order of their coming; one that fails is reported in the node's log.

    The thread is started by the first job, so by the loop itself, and has its scheduling from it: with a lower priority
    it could be held up while it holds the interpreter, and the loop with it.
    """

    def __init__(self, node: Node) -> None:
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        self._node = node
        self._thread = ThreadPoolExecutor(max_workers=1)

    def run(self, job: Callable[[], None]) -> None:
        """Run ``job`` soon."""
        self._thread.submit(job).add_done_callback(self._report)

    def close(self) -> None:
        """Wait for the jobs."""
        self._thread.shutdown(wait=True)

    def _report(self, done: Future[None]) -> None:
        error = done.exception()
        if error is not None:
            self._node.get_logger().error(f"a job beside the loop failed: {error!r}")
