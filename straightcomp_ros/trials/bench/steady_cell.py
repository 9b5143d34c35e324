"""cell, for measuring: goes on when the amplifier is switched off, so that an overloaded graph can be measured too.
It never ends by itself.

python -m straightcomp_ros.trials.bench.steady_cell --ros-args …
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

from std_srvs.srv import Trigger

from straightcomp_ros.nodes.cell_node import CellNode
from straightcomp_ros.runtime.runner import run

_PATIENCE_S = 5.0
_AGAIN_S = 0.5


class SteadyCell(CellNode):
    """Switches the amplifier on again whenever a fault has switched it off; ends when it is told to."""

    def _switch_on(self) -> Iterator[None]:
        deadline = time.monotonic() + _PATIENCE_S
        while time.monotonic() < deadline:
            answer = yield from self._switch(True)
            if answer.success:
                return
            yield from self._reset_fault()
        self.node.get_logger().warning(f"measuring with the amplifier off: {answer.message}")

    def _follow_motion(self, first_ns: int) -> Iterator[None]:
        duration = self._waypoints[-1].time_ns * 1e-9
        begin = tried = time.monotonic()
        while True:
            now = time.monotonic()
            print(f"progress {min((now - begin) / duration, 1.0):.3f}", flush=True)
            if not self._safety.amplifier_on and now - tried > _AGAIN_S:
                tried = now
                yield from self._reset_fault()
                yield from self._switch(True)
            yield

    def _reset_fault(self) -> Iterator[None]:
        if self._reset.service_is_ready():
            future = self._reset.call_async(Trigger.Request())
            yield from self._until(future.done, lambda: "the driver does not answer 'reset_fault'")
        yield


def main() -> int:
    """Run the node."""
    return run("cell", SteadyCell)


if __name__ == "__main__":
    sys.exit(main())
