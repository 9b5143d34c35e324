"""logger: records the graph's topics to a rosbag2 MCAP bag, as raw bytes."""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.bags import PARAMETERS_ATTACHMENT, BagError
from straightcomp_ros.bags.disk import DiskGuard
from straightcomp_ros.bags.intake import Intake
from straightcomp_ros.bags.losses import Losses
from straightcomp_ros.bags.origin import ORIGIN_METADATA, origin
from straightcomp_ros.bags.parameters import attach_map
from straightcomp_ros.bags.qos import TopicQos
from straightcomp_ros.bags.writer import FLUSH_AGE, BagWriter
from straightcomp_ros.cdr import header_stamp_ns
from straightcomp_ros.configuration import LoggerNodeParameters
from straightcomp_ros.contract import DIAGNOSTICS, ENCODER, STAGE_TRAJECTORY, STREAMS, UNCONNECTED
from straightcomp_ros.nodes.diagnostics import Diagnostics
from straightcomp_ros.nodes.managed import ManagedNode
from straightcomp_ros.nodes.remote_parameters import RemoteParameters
from straightcomp_ros.nodes.runner import run_managed
from straightcomp_ros.nodes.streams import RawQueue, message_type, stream_qos, unspun_node
from straightcomp_ros.parameters import ParameterError
from straightcomp_ros.timing.gaps import StampGaps
from straightcomp_ros.timing.histogram import Histogram
from straightcomp_ros.timing.report import LOST, OVERRUNS, SAMPLES, TIMER_ERROR, written

_FETCH_INTERVAL_NS = 20_000_000
_WRITE_INTERVAL_S = 0.02
_YIELD_EVERY = 8


class LoggerPart:
    """Fetches all messages 50 times a second, and writes on a thread of its own: the disk never holds up receiving."""

    def __init__(self, node: ManagedNode, parameters: LoggerNodeParameters) -> None:
        self.node, self.loop = node, None
        self._chosen = _pattern(parameters.topics)
        folder = Path(parameters.output or datetime.now().strftime("straightcomp_%Y_%m_%d-%H_%M_%S"))
        self._bag = BagWriter(folder, compression=parameters.compression)
        self._encoder = node.resolve_topic_name(ENCODER.topic)
        self._samples = self._overruns = self._fetched_ns = 0
        self._gaps, self._timer_errors = StampGaps(), Histogram()
        self._bag.add_metadata(ORIGIN_METADATA, origin())
        self._intake = Intake(parameters.queue_limit, parameters.snapshot)
        self._losses, self._disk = Losses(), DiskGuard(folder, parameters.min_free_bytes)
        self._received = self._written = 0
        self._topics: dict[str, RawQueue] = {}
        self._unspun = unspun_node(node)
        self._failure: Exception | None = None
        self._attached = False
        self._stopping = threading.Event()
        for stream in STREAMS:
            self._record(message_type(stream.layout.type_name), stream.topic, stream_qos(parameters.queue_depth))
        self._record(JointTrajectory, STAGE_TRAJECTORY, QoSProfile(depth=10))
        self._record(DiagnosticArray, DIAGNOSTICS, QoSProfile(depth=100))
        self._stamped = {node.resolve_topic_name(stream.topic) for stream in STREAMS}
        for name, action in (("pause", self._pause), ("resume", self._resume), ("snapshot", self._snapshot)):
            node.create_service(Trigger, f"~/{name}", action)
        self._remote = RemoteParameters(node, parameters.nodes.split())
        Diagnostics(node, self._counters)
        node.create_timer(_FETCH_INTERVAL_NS * 1e-9, self._fetch)
        node.create_timer(0.2, self._watch)
        self._thread = threading.Thread(target=self._write_until_stopped, name="bag writer")
        self._thread.start()
        self._folder = folder

    def activate(self) -> None:
        """Record what comes from now on."""
        self._drop()
        self.node.get_logger().info(f"recording to {self._folder}")

    def deactivate(self) -> None:
        """Record what has come; the bag stays open."""
        self._take()

    def prepare(self, parameters: LoggerNodeParameters) -> Callable[[], None]:
        """The free space that must stay may change."""
        guard = DiskGuard(self._folder, parameters.min_free_bytes)

        def take_over() -> None:
            self._disk = guard

        return take_over

    def _record(self, kind: Any, topic: str, qos: QoSProfile) -> None:
        if not self._chosen.fullmatch(topic):
            return
        full_name = self.node.resolve_topic_name(topic)
        self._bag.add_topic(
            full_name,
            f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}",
            TopicQos(reliability=qos.reliability.name.lower(), depth=qos.depth),
        )
        self._topics[full_name] = RawQueue(self._unspun, kind, full_name, qos)

    def _pause(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._fetch()
        self._intake.paused = True
        response.success, response.message = True, "paused: what comes now is not recorded"
        return response

    def _resume(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._fetch()
        self._intake.paused = False
        response.success, response.message = True, "recording"
        return response

    def _snapshot(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._fetch()
        response.message = f"{self._intake.snapshot()} messages go to the bag"
        response.success = True
        return response

    def _fetch(self) -> None:
        self._note_time()
        if self.node.active:
            self._take()
        else:
            self._drop()

    def _drop(self) -> None:
        for messages in self._topics.values():
            for _ in messages.fetch():
                pass

    def _take(self) -> None:
        add = self._intake.add
        for topic, messages in self._topics.items():
            for data, info in messages.fetch():
                self._received += 1
                if topic == self._encoder:
                    self._samples += 1
                    self._gaps.see(header_stamp_ns(data))
                if not self._received % _YIELD_EVERY:
                    # With real-time scheduling nodes of the same priority would have to wait for the end of this.
                    os.sched_yield()
                add(topic, data, info["received_timestamp"], info["source_timestamp"])

    def _note_time(self) -> None:
        # The executor's timer tells nothing of its own lateness: what counts is how long messages had to wait.
        now = time.monotonic_ns()
        if self._fetched_ns:
            late_ns = max(0, now - self._fetched_ns - _FETCH_INTERVAL_NS)
            self._timer_errors.record(late_ns)
            self._overruns += late_ns // _FETCH_INTERVAL_NS
        self._fetched_ns = now

    def _write_until_stopped(self) -> None:
        try:
            while not self._stopping.wait(_WRITE_INTERVAL_S):
                self._write_queue()
                self._disk.check()
                if self._remote.complete and not self._attached:
                    # Now, not at the end: after a SIGKILL the bag still says what it is of.
                    self._attach()
                self._bag.flush_older(FLUSH_AGE)
            self._write_queue()
        except (OSError, BagError) as error:
            self._failure = error

    def _attach(self) -> None:
        self._attached = True
        self._bag.attach(PARAMETERS_ATTACHMENT, "application/yaml", self._remote.as_yaml().encode())
        refusal = attach_map(self._bag, self._remote.values)
        if refusal:
            self.node.get_logger().warning(refusal)

    def _write_queue(self) -> None:
        queue = self._intake.queue
        for _ in range(len(queue)):
            message = queue.popleft()
            self._bag.write(*message)
            self._written += 1
            if message[0] in self._stamped:
                self._losses.add(*message[:2])

    def _watch(self) -> None:
        if self._failure:
            self.node.fail(self._failure)

    def _counters(self) -> dict[str, object]:
        counters: dict[str, object] = {
            SAMPLES: self._samples,
            LOST: self._gaps.lost,
            OVERRUNS: self._overruns,
            "received": self._received,
            "written": self._written,
            "dropped": self._intake.dropped,
            "queued": len(self._intake.queue),
            UNCONNECTED: " ".join(topic for topic, queue in self._topics.items() if not queue.connected),
            **written(TIMER_ERROR, self._timer_errors.take()),
        }
        if self._failure:
            counters["error"] = f"recording stopped: {self._failure}"
        return counters

    def close(self) -> None:
        """Write what has come, attach the parameters, finish the bag."""
        self._unspun.destroy_node()
        self._stopping.set()
        self._thread.join()
        with self._bag:  # finishes the bag even where the disk takes nothing more of these
            if not self._attached:
                self._attach()
            counts = {"received": self._received, "written": self._written, "dropped": self._intake.dropped}
            self._bag.add_metadata("logger", {name: str(count) for name, count in counts.items()})
            self._bag.add_metadata("losses", {topic: str(count) for topic, count in self._losses.by_topic().items()})


def _pattern(text: str) -> re.Pattern[str]:
    try:
        return re.compile(text)
    except re.error as error:
        raise ParameterError(f"parameter 'topics': {text!r}: {error}; allowed: a regular expression") from error


def main() -> int:
    """Entry point of `ros2 run straightcomp_ros logger_node`."""
    return run_managed("logger", LoggerNodeParameters, LoggerPart)


if __name__ == "__main__":
    sys.exit(main())
