"""feedforward: takes encoder samples, publishes the straightness reference for each."""

import math
import time
from collections.abc import Callable
from functools import partial

from std_srvs.srv import SetBool, Trigger

from straightcomp_ros.contract import ENCODER, REFERENCE
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import FeedforwardNodeParameters
from straightcomp_ros.runtime.loops import MessageLoop, awaited
from straightcomp_ros.runtime.managed import ManagedNode
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.runtime.runner import run_managed
from straightcomp_ros.runtime.safety_panel import tripper
from straightcomp_ros.runtime.streams import LOOK_AHEAD_S
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.straightness.feedforward import FADE_TIME, Feedforward, follower
from straightcomp_ros.straightness.guide_map import StraightnessMap, load_map
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.timing.delays import StampGaps
from straightcomp_ros.timing.node_timing import LOST, SAMPLES

_LOOK_AT_MAP_S = 0.02
_BATCH_NS = round(LOOK_AHEAD_S * 1e9)


def _middle(_: float) -> tuple[float, float, float]:
    """The reference in the middle of the platform's travel, for every x."""
    return 0.0, 0.0, 0.0


class FeedforwardComponent:
    """Looks up the reference of each sample in the map, several samples at a time.

    The controller extrapolates an earlier reference, so it never waits for this node.
    """

    def __init__(self, node: ManagedNode, parameters: FeedforwardNodeParameters) -> None:
        self._node, self._parameters = node, parameters
        self._map = load_map(parameters.stage.guide)
        self._report_map()
        stage = parameters.stage
        tracking = stage.tracking(parameters.feedforward, self._map)
        self._feedforward = Feedforward(self._map, tracking, stage.motion.highest_speed, stage.encoder.x_noise)
        self._publish = node.streams.publisher(REFERENCE, None)
        self._trip = tripper(node)
        self._samples = 0
        self._x = math.nan
        self._centred = False
        self._gaps = StampGaps()
        self._queue = node.streams.batches(ENCODER)
        self.loop = MessageLoop(_BATCH_NS, self._queue.wait, self._cycle)
        node.streams.follow(self._cycle)
        node.offer(Trigger, "~/reload_map", self._on_reload_map, ParameterError, SurveyError, OSError)
        node.offer(SetBool, "~/center", self._on_center, ParameterError)
        node.create_timer(_LOOK_AT_MAP_S, self._look_at_map)
        Diagnostics(node, self._counters, self.loop.report, description=parameters.stage.identity)

    def activate(self) -> None:
        """Start with the samples that arrive from now on."""
        self._queue.fetch()
        self._gaps.interrupt()
        self._feedforward.reset()
        self._x = math.nan

    def deactivate(self) -> None:
        """Stop publishing references: the controller then sends no command, and the driver switches off."""
        self._publish.finish()

    def prepare(self, parameters: FeedforwardNodeParameters) -> Callable[[], None]:
        """Load another map; the reference fades over to it."""
        self._refuse_while_changing()

        def load() -> tuple[StraightnessMap, float]:
            straightness = load_map(parameters.stage.guide)
            return straightness, parameters.stage.tracking(parameters.feedforward, straightness).bandwidth

        # In the worker thread, where samples are answered meanwhile: it takes longer than the controller waits.
        straightness, bandwidth = awaited(load, self._node.go_on)
        # With the first sample meanwhile, a change from before it has begun.
        self._refuse_while_changing()

        def take_over() -> None:
            self._parameters, self._map = parameters, straightness
            self._report_map()
            self._feedforward.bandwidth = bandwidth
            if not self._centred:
                self._feedforward.change(follower(straightness))

        return take_over

    def _refuse_while_changing(self) -> None:
        if self._feedforward.changing:
            raise ParameterError(f"the previous change of reference takes {FADE_TIME:g} s; try again after it")

    def _report_map(self) -> None:
        self._node.get_logger().info(f"map {self._parameters.stage.guide.file}: {self._map}")
        if wrong := self._map.mismatch():
            self._node.get_logger().error(wrong)

    def _on_reload_map(self) -> str:
        """Read the map's file again; the reference fades over to it."""
        self.prepare(self._parameters)()
        return f"map {self._parameters.stage.guide.file}: {self._map}"

    def _on_center(self, middle: bool) -> str:
        """Fade the reference to the middle of the platform's travel, or back to the map."""
        self._refuse_while_changing()
        if middle != self._centred:
            self._centred = middle
            self._feedforward.change(_middle if middle else follower(self._map))
        return f"reference goes to {'the middle of the travel' if middle else 'the map'}"

    def _look_at_map(self) -> None:
        # Beyond the survey the reference runs out to a constant. That is harmless, so there is time to request a stop.
        low, high = self._map.span
        runout = self._parameters.stage.guide.runout
        if self._node.active and not low - runout <= self._x <= high + runout and math.isfinite(self._x):
            self._trip(
                Fault.MAP_MISSING,
                f"x = {self._x * 1e3:.1f} mm; the map {self._parameters.stage.guide.file} covers "
                f"{low * 1e3:.1f} to {high * 1e3:.1f} mm",
            )

    def _cycle(self) -> tuple[int, int]:
        """Answer the samples that have arrived; return for how many batches, and how long the oldest waited, in ns."""
        samples = self._queue.fetch()
        if not samples:
            return 0, 0
        age_ns = max(0, time.time_ns() - samples[0][2])
        for stamp_ns, numbers, _ in samples:
            self._samples += 1
            self._gaps.see(stamp_ns)
            self._x = numbers[0]
            self._publish(stamp_ns, *self._feedforward.step(stamp_ns, self._x))
        self._publish.publish_batch()
        return 1 + age_ns // _BATCH_NS, age_ns

    def _counters(self) -> dict[str, object]:
        return {SAMPLES: self._samples, LOST: self._gaps.lost}

    def close(self) -> None:
        """There is nothing to release."""


FEEDFORWARD = "feedforward", FeedforwardNodeParameters, FeedforwardComponent
main = partial(run_managed, [FEEDFORWARD])
"""Entry point of `ros2 run straightcomp_ros feedforward_node`."""
