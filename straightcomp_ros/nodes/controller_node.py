"""controller: encoder samples and their references in, control current out."""

from __future__ import annotations

import sys
import time

from rclpy.node import Node
from rclpy.task import Future

from straightcomp_ros.configuration import ControllerNodeParameters
from straightcomp_ros.contract import COMMAND, CONTROLLER_STATE, ENCODER, REFERENCE
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.control.learning import make_learning
from straightcomp_ros.control.pairing import Pairing
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.nodes.beside_the_loop import BesideTheLoop
from straightcomp_ros.nodes.declare import declare
from straightcomp_ros.nodes.diagnostics import Diagnostics
from straightcomp_ros.nodes.periodic import PeriodicLoop
from straightcomp_ros.nodes.phase_lock import PhaseLock
from straightcomp_ros.nodes.runner import run
from straightcomp_ros.nodes.streams import BurstPublisher, Inbox, publisher, subscribe, unspun_node
from straightcomp_ros.timing.gaps import StampGaps
from straightcomp_ros.timing.report import LOST, OVERRUNS, SAMPLES

_SAMPLE_WAIT_NS = 50_000
"""How long a sample is to wait for the cycle that uses it: the usual jitter of its arrival."""

_LOOKS = 5
_LOOK_AGAIN_S = 40e-6


class ControllerNode:
    """Pairs each sample with its reference and steps the law, on the timer or on arrival.

    When a cycle finds several new samples the law steps through all of them in order: its velocity
    estimate and its integral need every sample, and a replay of the bag gives the same commands.
    """

    def __init__(self, node: Node) -> None:
        parameters = declare(node, ControllerNodeParameters)
        self.node, self.done, self.realtime = node, Future(), parameters.realtime
        self._learner: BesideTheLoop | None = None
        if parameters.learning.learn and parameters.trigger == "timer":
            self._learner = BesideTheLoop(node)
        self._learning = make_learning(
            parameters.learning,
            parameters.control.law,
            parameters.rate,
            self._learner.run if self._learner is not None else lambda job: job(),
        )
        self._servo = Servo(make_law(parameters.control, 1.0 / parameters.rate), learning=self._learning)
        self._pairing = Pairing(parameters.lead_ns, wait=parameters.trigger == "sample")
        self._publish_command = publisher(node, COMMAND)
        self._publish_state = BurstPublisher(node, CONTROLLER_STATE)
        self._samples_seen = self._commands = self._refused = self._idle_cycles = 0
        self._gaps = StampGaps()
        self.loop: PeriodicLoop | None = None
        if parameters.trigger == "sample":
            subscribe(node, ENCODER, self._on_sample)
            subscribe(node, REFERENCE, self._on_reference)
        else:
            unspun = unspun_node(node)
            self._samples, self._references = Inbox(node, unspun, ENCODER), Inbox(node, unspun, REFERENCE)
            period_ns = round(1e9 / parameters.rate)
            self._phase = PhaseLock(period_ns, _SAMPLE_WAIT_NS)
            self.loop = PeriodicLoop(period_ns, self._cycle)
        Diagnostics(node, self._counters)

    def _add_sample(self, stamp_ns: int, numbers: list[float]) -> None:
        self._samples_seen += 1
        self._gaps.see(stamp_ns)
        self._pairing.add_sample(stamp_ns, numbers)

    def _on_sample(self, stamp_ns: int, numbers: list[float]) -> None:
        self._add_sample(stamp_ns, numbers)
        self._answer()

    def _on_reference(self, stamp_ns: int, numbers: list[float]) -> None:
        self._pairing.add_reference(stamp_ns, numbers)
        self._answer()

    def _cycle(self, _: int) -> None:
        for _ in range(_LOOKS):
            samples = self._samples.fetch()
            if samples:
                break
            # Just too early would cost a whole period of latency: better look again, a little later.
            time.sleep(_LOOK_AGAIN_S)
        else:
            self._idle_cycles += 1
        fetched_ns = time.time_ns()
        for stamp_ns, numbers, _ in samples:
            self._add_sample(stamp_ns, numbers)
        self._answer()
        # References are for samples to come: nothing waits for this.
        for stamp_ns, numbers, _ in self._references.fetch():
            self._pairing.add_reference(stamp_ns, numbers)
        if samples and self.loop:
            self.loop.shift(self._phase.shift_ns(fetched_ns - samples[-1][2]))

    def _answer(self) -> None:
        for stamp_ns, sample, reference, age_ns in self._pairing.take():
            command = self._servo.step(stamp_ns, sample[1], sample[3], reference, sample[0])
            if command is None:
                self._refused += 1
                continue
            self._publish_command(stamp_ns, command.current)
            self._publish_state(stamp_ns, *command[1:], age_ns * 1e-9)
            self._commands += 1

    def _counters(self) -> dict[str, object]:
        return {
            SAMPLES: self._samples_seen,
            LOST: self._gaps.lost,
            "commands": self._commands,
            "refused_samples": self._refused,
            "unmatched_samples": self._pairing.unmatched,
            "idle_cycles": self._idle_cycles,
            "phase_error_us": self._phase.error_ns * 1e-3 if self.loop else 0.0,
            **(self.loop.report() if self.loop else {OVERRUNS: 0}),
            **(self._learning.counters() if self._learning is not None else {}),
        }

    def close(self) -> None:
        """Keep what was learned. Nothing to make safe: the driver switches off when no command comes."""
        self._publish_state.flush()
        if self._learner is not None:
            self._learner.close()
        if self._learning is not None:
            self._learning.save()


def main() -> int:
    """Entry point of `ros2 run straightcomp_ros controller_node`."""
    return run("controller", ControllerNode)


if __name__ == "__main__":
    sys.exit(main())
