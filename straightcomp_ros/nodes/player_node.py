"""player: publishes a bag's samples in place of the driver, at the recorded rate and with the recorded stamps."""

import time
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import median_high

from rclpy.task import Future
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from straightcomp_ros.analysis.interruption import played
from straightcomp_ros.bags import BagError, noting_warnings
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.contract import CLOCK, COMMAND, ENCODER, POSITION_EVERY
from straightcomp_ros.parameters.node_parameters import PlayerNodeParameters
from straightcomp_ros.runtime.guarded_node import GuardedNode
from straightcomp_ros.runtime.loops import PeriodicLoop
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.runtime.ros_parameters import declare
from straightcomp_ros.runtime.runner import EXIT_FAILURE, Runnable, run
from straightcomp_ros.runtime.streams import Streams, stream_publisher, stream_qos
from straightcomp_ros.timing.node_timing import SAMPLES

_AFTERPLAY_S = 0.5
"""Time for the other nodes to answer the last samples."""
_SILENCE_NS = 1_000_000_000
"""After so long without an answer the player goes on without one."""
_REMIND_S = 5.0
"""From one line about what the player waits for to the next."""


class PlayerNode(Runnable):
    """Plays a bag. It keeps the bag's stamps, since they pair samples, references and commands."""

    def __init__(self, node: GuardedNode) -> None:
        self._parameters = parameters = declare(node, PlayerNodeParameters)
        self.node, self.done, self.realtime = node, Future(), parameters.realtime
        if not parameters.bag:
            raise BagError("parameter 'bag' is empty; allowed: a rosbag2 folder or an MCAP file")
        with noting_warnings() as texts:
            streams = read_streams(
                Path(parameters.bag), {ENCODER.topic: ENCODER.layout}, {ENCODER.topic: parameters.topic}
            )
        for text in texts:
            node.get_logger().warning(text)
        if ENCODER.topic not in streams:
            raise BagError(f"bag {parameters.bag}: has no messages on '{parameters.topic}'")
        stream = streams[ENCODER.topic]
        stamps = stream.stamp.tolist()
        rows = zip(*(stream.columns[name].tolist() for name in ENCODER.layout.columns), strict=True)
        self._messages = [ENCODER.layout.pack(stamp, *row) for stamp, row in zip(stamps, rows, strict=True)]
        # A pause of the recording, or a jump of its clock, is not waited out.
        self._due_ns = [round(time_ns / parameters.speed) for time_ns in played(stream.stamp).tolist()]
        self._publisher = stream_publisher(node, ENCODER)
        self._stamps = stamps
        self._clock = node.create_publisher(Clock, CLOCK, stream_qos(1)) if parameters.clock else None
        self._deadline = time.monotonic() + parameters.start_timeout
        self._start_ns: int | None = None
        self._end_ns = 0
        self._next = 0
        self._ahead = parameters.ahead or len(stamps)
        self._places = {stamp: place for place, stamp in enumerate(stamps)}
        self._answered, self._progress_ns = 0, 0
        self._queue = Streams(node).queue(COMMAND) if parameters.ahead else None
        steps_ns = [later - sooner for sooner, later in pairwise(self._due_ns)]
        self.loop = PeriodicLoop(max(median_high(steps_ns or [0]), 50_000), self._cycle)
        Diagnostics(node, lambda: {SAMPLES: self._next}, self.loop.missed.report)

    def _cycle(self, wake_ns: int) -> None:
        if self._start_ns is None:
            self._wait(wake_ns)
            return
        now_ns = time.monotonic_ns()
        elapsed_ns = now_ns - self._start_ns
        if not self._next and elapsed_ns >= 0 and self._lacking():
            self._start_ns = None
            return
        due, messages, publish = self._due_ns, self._messages, self._publisher.publish
        self._see_answers(now_ns)
        end = min(len(due), self._answered + self._ahead)
        while self._next < end and due[self._next] <= elapsed_ns:
            publish(messages[self._next])
            if self._clock is not None and self._next % POSITION_EVERY == 0:
                self._clock.publish(Clock(clock=Time(nanoseconds=self._stamps[self._next]).to_msg()))
            self._next += 1
        if self._next < len(due):
            self._end_ns = now_ns
        elif now_ns > self._end_ns + _AFTERPLAY_S * 1e9 and not self.done.done():
            self.node.get_logger().info(f"played {self._next} samples")
            self.done.set_result(0)

    def _see_answers(self, now_ns: int) -> None:
        if self._queue is None:
            return
        for stamp_ns, _, _ in self._queue.fetch():
            self._answered = max(self._answered, self._places.get(stamp_ns, -1) + 1)
            self._progress_ns = now_ns
        if now_ns - self._progress_ns > _SILENCE_NS:
            # No answer will come any more: samples or commands were lost.
            self._answered, self._progress_ns = self._next, now_ns

    def _wait(self, wake_ns: int) -> None:
        lacking = self._lacking()
        if not lacking:
            # A subscriber that has just been discovered is connected a moment later.
            self._start_ns = wake_ns + 1_000_000_000
        elif time.monotonic() > self._deadline and not self.done.done():
            self.node.get_logger().error(f"after {self._parameters.start_timeout:g} s {lacking}")
            self.done.set_result(EXIT_FAILURE)
        else:
            self.node.get_logger().info(f"waiting: {lacking}", throttle_duration_sec=_REMIND_S, skip_first=True)

    def _lacking(self) -> str:
        """What keeps the player from beginning: others that publish samples, a machine's driver perhaps, which two
        sources would trip, or too few subscribers. A node that was killed publishes until DDS forgets it."""
        topic, wanted = self._publisher.topic_name, self._parameters.subscribers
        if (others := self.node.count_publishers(topic) - 1) > 0:
            return (
                f"'{topic}' has {others} other publisher(s), as a running machine has; end them, or play in another "
                "namespace or ROS_DOMAIN_ID"
            )
        if (count := self._publisher.get_subscription_count()) < wanted:
            return f"'{topic}' has {count} subscriber(s); parameter 'subscribers' asks for {wanted}"
        return ""


main = partial(run, "player", PlayerNode)
"""Entry point of `ros2 run straightcomp_ros player_node`."""
