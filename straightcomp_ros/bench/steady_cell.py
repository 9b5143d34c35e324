"""cell, for measurements: continues when the amplifier goes off, so that an overloaded graph can be measured too.
It never ends by itself.

python -m straightcomp_ros.bench.steady_cell --ros-args …
"""

import sys
from collections.abc import Iterator
from dataclasses import replace

from straightcomp_ros.cell.cell_sequence import CellSequence
from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.nodes.cell_node import CellNode
from straightcomp_ros.runtime.runner import run

_PATIENCE_S = 5.0


class SteadySequence(CellSequence):
    """Switches the amplifier on again whenever a fault has switched it off; ends only on command."""

    began = duration = 0.0
    """Of the motion, s."""

    def _starting(self) -> Iterator[None]:
        while not (self.seen.amplifier_on or self._overdue(_PATIENCE_S)):
            self._switch_on_again()
            yield
        if not self.seen.amplifier_on:
            print(f"measuring with the amplifier off: {self.machine.refusal}", file=sys.stderr, flush=True)

    def _execute(self) -> Iterator[None]:
        waypoints = self.movements.next(self.seen, self.now)
        self.machine.move(waypoints)
        self.began, self.duration = self.now, waypoints[-1].time_ns * 1e-9
        while True:
            if not self.seen.amplifier_on:
                self._switch_on_again()
            yield

    def _switch_on_again(self) -> None:
        if self._due():
            self.machine.reset_faults()
            self.machine.switch_on()

    def tick(self, seen: Observation) -> None:
        """Continue, whatever faults there are."""
        super().tick(replace(seen, faults={}))

    def _trouble(self, seen: Observation) -> str:
        return ""

    @property
    def progress(self) -> float:
        """Progress by the clock, since samples may be missing."""
        return (self.now - self.began) / self.duration if self.duration else 0.0


def main() -> int:
    """Run the node."""
    return run("cell", lambda node: CellNode(node, SteadySequence))


if __name__ == "__main__":
    sys.exit(main())
