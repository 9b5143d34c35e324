"""logger: records the graph's topics to a rosbag2 MCAP bag, as raw bytes; packs an incident at each latched fault."""

import re
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.recorded_nodes import attach_parameters, note_changes
from straightcomp_ros.bags.recorder import Recorder
from straightcomp_ros.bags.topics import Topic, definition
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.cell.launcher import verb_command
from straightcomp_ros.contract import (
    DIAGNOSTICS,
    DISPLACEMENT,
    ENCODER,
    SAFETY_STATE,
    STAGE_TRAJECTORY,
    STREAMS,
    UNCONNECTED,
    Stream,
)
from straightcomp_ros.messages.cdr import header_stamp_ns
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import LoggerNodeParameters
from straightcomp_ros.runtime.graph_client import RemoteParameters
from straightcomp_ros.runtime.guarded_node import RUN_FAILURES, Refused
from straightcomp_ros.runtime.managed import ManagedNode
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.runtime.other_topics import OtherTopics, stored
from straightcomp_ros.runtime.runner import run_managed
from straightcomp_ros.runtime.safety_panel import LATCHED
from straightcomp_ros.runtime.streams import BatchQueue, RawQueue, message_class, stream_qos
from straightcomp_ros.timing.delays import Histogram, StampGaps
from straightcomp_ros.timing.node_timing import LOST, OVERRUNS, SAMPLES, TIMER_ERROR, written

LAST_S = 60
"""Time in s before the fault that an incident has: some 30 MB at 2 kHz, which bounds its size."""
_AFTER_S = 2.0
"""Wait in s after the fault, in which each node reports it once and the bag has what follows it."""
_AT_END_S = 3.0
"""Longest wait at the end of the node: a launcher that has no answer for 5 s ends it by force."""
_OWN_NAMES = "????_??_??-??_??_??_*.zip"
"""Of the incidents that are packed here: another file in their folder is the user's."""
_IDLE = ("chrt", "--idle", "0")
"""Before a command: it then takes no CPU from any node, whatever priority the node has that starts it."""


class FaultIncidents:
    """Watches `safety_state`; keeps the newest ``number`` incidents beside the bag that ``recording`` returned at the
    fault, None while there is none. ``save`` completes that bag first, if it is still recorded, in as many turns of the
    timer as it yields. One at a time: a fault while an incident of the same bag waits is in that one.

    Attributes:
        due: the incidents that wait, by their bags: when to pack each, and the fault's name.
    """

    def __init__(
        self,
        node: Node,
        number: int,
        recording: Callable[[], Path | None],
        save: Callable[[], Iterable[None]] = tuple,
    ) -> None:
        self._node, self._number, self._recording, self._save = node, number, recording, save
        self.due: dict[Path, tuple[float, str]] = {}
        self._packing: Iterator[None] = iter(())
        self._seen = ""
        node.create_subscription(DiagnosticStatus, SAFETY_STATE, self._on_safety_state, LATCHED)
        node.create_timer(0.5, partial(next, self._work()))

    def close(self) -> None:
        """Pack at once what waits; the bags are finished. What takes longer goes on when this process has ended."""
        packing = [self._packing, *(self._pack(bag, fault) for bag, (_, fault) in self.due.items())]
        end = time.monotonic() + _AT_END_S
        while any([next(one, self) is None for one in packing]) and time.monotonic() < end:
            time.sleep(0.05)

    def _on_safety_state(self, status: DiagnosticStatus) -> None:
        fault = f"{status.name} {[one.value for one in status.values]}" if status.name else ""
        bag = self._recording()
        if bag and fault and fault != self._seen:
            self.due.setdefault(bag, (time.monotonic() + _AFTER_S, status.name))
        self._seen = fault

    def _work(self) -> Iterator[None]:
        """Pack incidents, one at a time; each ``yield`` waits for the timer."""
        while True:
            yield
            for bag, (when, fault) in list(self.due.items()):
                if time.monotonic() >= when:
                    del self.due[bag]
                    self._packing = self._pack(bag, fault)
                    yield from self._packing

    def _pack(self, bag: Path, fault: str) -> Iterator[None]:
        if bag == self._recording():  # else that bag is finished
            yield from self._save()
        folder = bag.absolute().with_name(f"{bag.absolute().name}_incidents")
        file = folder / f"{datetime.now():%Y_%m_%d-%H_%M_%S}_{fault}.zip"
        words = [*_IDLE, *verb_command("incident", str(bag), "--last", str(LAST_S), "-o", str(file))]
        try:
            folder.mkdir(exist_ok=True)
            # In a session of its own: Ctrl-C in the terminal ends the nodes, not this.
            process = subprocess.Popen(
                words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
            )
        except OSError as error:
            self._node.get_logger().warning(f"the incident of {fault} was not packed: {error}")
            return
        self._node.get_logger().info(f"packing the incident of {fault}: {file}")
        while process.poll() is None:
            yield
        if process.returncode:
            self._node.get_logger().warning(f"the incident was not packed: exit code {process.returncode}")
        else:
            self._keep_newest(file)

    def _keep_newest(self, file: Path) -> None:
        try:
            # The file just packed is the newest; what seems newer is from before the clock was set back.
            others = sorted(
                set(file.parent.glob(_OWN_NAMES)) - {file},
                key=lambda one: (one.name < file.name, one.name),
                reverse=True,
            )
            for old in others[self._number - 1 :]:
                old.unlink()
        except OSError as error:
            self._node.get_logger().warning(f"an old incident was not removed: {error}")


_FETCH_INTERVAL_NS = 20_000_000


class LoggerComponent:
    """Fetches all messages 50 times a second; the recorder's own thread writes them."""

    def __init__(self, node: ManagedNode, parameters: LoggerNodeParameters) -> None:
        self.node, self.loop = node, None
        self._encoder = node.resolve_topic_name(ENCODER.topic)
        self._samples = self._overruns = self._received = self._fetched_ns = 0
        self._gaps, self._timer_errors = StampGaps(), Histogram()
        self._chosen = chosen_topics(parameters.topics)
        others = _pattern("other_topics", parameters.other_topics)
        self._topics: dict[str, RawQueue | BatchQueue] = {}
        self._silent: dict[str, Topic] = {}
        """Topics that have had no message yet."""
        nodes = parameters.nodes.split()
        self._expects_map = any(name.rpartition("/")[2] == "feedforward" for name in nodes)
        self._remote = RemoteParameters(node, nodes)
        self._described: tuple[BagWriter, Mapping[str, Mapping[str, object]]] | None = None
        """The last bag that has the nodes' parameters, and those."""
        stamped = [node.resolve_topic_name(stream.topic) for stream in STREAMS]
        self._recorder = recorder = Recorder(parameters, stamped, self._describe)
        for stream in STREAMS:
            self._record(stream.topic, stream.layout.type_name, stream_qos(parameters.queue_depth), stream)
        self._record(STAGE_TRAJECTORY, "trajectory_msgs/msg/JointTrajectory", QoSProfile(depth=10))
        self._record(DIAGNOSTICS, "diagnostic_msgs/msg/DiagnosticArray", QoSProfile(depth=100))
        ours = [*self._topics, *(node.resolve_topic_name(stream.batch_topic) for stream in STREAMS)]
        # Only a survey has a sensor: its topic is in the bag once a node publishes it.
        sensor = {node.resolve_topic_name(DISPLACEMENT.topic): DISPLACEMENT.layout.type_name}
        expected = sensor if DISPLACEMENT.topic in self._chosen else {}
        self._others = OtherTopics(node, node.streams, others, expected, ours, self._recorder.announce)
        self._provide_services()
        Diagnostics(node, self._counters)
        node.create_timer(_FETCH_INTERVAL_NS * 1e-9, self._fetch)
        node.create_timer(0.2, self._watch)
        self._incidents: FaultIncidents | None = None
        if parameters.incidents:
            save = self._save_snapshot if parameters.snapshot else tuple
            self._incidents = FaultIncidents(
                node, parameters.incidents, lambda: recorder.folder if recorder.recording else None, save
            )
        if parameters.record_at_start:
            self._start()

    def activate(self) -> None:
        """Record the messages that arrive from now on."""
        self._drop()
        if self._recorder.recording:
            self._others.repeat(self._recorder.intake.add)
            self.node.get_logger().info(f"recording to {self._recorder.folder}")

    def deactivate(self) -> None:
        """Record the messages that have arrived; the bag stays open, and what it lacks from now on is not lost."""
        self._take()
        self._recorder.intake.interrupt()
        self._gaps.interrupt()

    def prepare(self, parameters: LoggerNodeParameters) -> Callable[[], None]:
        """Prepare another limit of free disk space."""
        return partial(self._recorder.keep_free, parameters.min_free_bytes)

    def _record(self, topic: str, type_name: str, qos: QoSProfile, stream: Stream | None = None) -> None:
        if topic not in self._chosen:
            return
        full_name, streams = self.node.resolve_topic_name(topic), self.node.streams
        # The first definition takes half a second to load: do it before the bag's first message arrives.
        definition(type_name)
        # The publisher's QoS is known when it exists: at the first message.
        self._silent[full_name] = Topic(full_name, type_name, stored([qos]))
        self._recorder.expect(self._silent[full_name])
        self._topics[full_name] = (
            streams.raw_batches(stream, qos.depth, complete=True)
            if stream
            else streams.raw(message_class(type_name), topic, qos)
        )

    def _provide_services(self) -> None:
        """Make the services ``~/start``, ``~/stop`` and so on. Each acts on the messages that arrive after it."""
        recorder = self._recorder

        def stop() -> str:
            """Finish the bag."""
            self._finish()
            return f"{recorder.written} messages are in {recorder.folder}"

        def pause() -> str:
            """Leave later messages out of the bag."""
            recorder.intake.pause()
            return "paused: messages are not recorded until ~/resume"

        def resume() -> str:
            """Record again."""
            recorder.intake.paused = False
            return "recording"

        def split() -> str:
            """Continue in the bag's next file."""
            recorder.split()
            return "the bag continues in a new file"

        def snapshot() -> str:
            """Write the last seconds from memory (parameter snapshot) to the bag."""
            return f"{recorder.intake.snapshot()} messages go to the bag"

        for act in (self._start, stop, pause, resume, split, snapshot):
            name = act.__name__.strip("_")
            self.node.offer(Trigger, f"~/{name}", partial(self._answer, act, name != "start"))

    def _answer(self, act: Callable[[], str], needs_bag: bool) -> str:
        self._fetch()
        if needs_bag and not self._recorder.recording:
            raise Refused("nothing is being recorded; allowed after ~/start")
        try:
            return act()
        except BagError as error:
            raise Refused(str(error)) from error

    def _save_snapshot(self) -> Iterator[None]:
        """Write what is in memory to the bag; each ``yield`` waits for the disk."""
        self._recorder.intake.snapshot()
        while self._recorder.intake.queue:
            yield
        yield  # for the open chunk, which the recorder writes when it is FLUSH_AGE old

    def _start(self) -> str:
        """Record to a new bag."""
        folder = self._recorder.start()
        self._others.repeat(self._recorder.intake.add)
        return f"recording to {folder}"

    def _finish(self) -> None:
        if self._incidents and self._recorder.folder in self._incidents.due:
            self._recorder.intake.snapshot()  # what is in memory only would be lost to the incident
        self._recorder.stop()

    def _fetch(self) -> None:
        self._note_time()
        if self.node.active:
            self._take()
        else:
            self._drop()

    def _drop(self) -> None:
        self._others.fetch(lambda *_: None)
        for messages in self._topics.values():
            messages.fetch()

    def _take(self) -> None:
        add = self._recorder.intake.add
        self._received += self._others.fetch(add)
        for topic, queue in self._topics.items():
            messages = queue.fetch()
            if messages and topic in self._silent:
                self._announce(topic)
            for data, info in messages:
                self._received += 1
                if topic == self._encoder:
                    self._samples += 1
                    self._gaps.see(header_stamp_ns(data))
                add(topic, data, info["received_timestamp"], info["source_timestamp"])

    def _announce(self, topic: str) -> None:
        announced = self._silent.pop(topic)
        if publishers := self.node.get_publishers_info_by_topic(topic):
            announced = replace(announced, qos=stored([publisher.qos_profile for publisher in publishers]))
        self._recorder.announce(announced)

    def _note_time(self) -> None:
        # The executor does not report how late its timer is. What counts is how long messages had to wait.
        now = time.monotonic_ns()
        if self._fetched_ns:
            late_ns = max(0, now - self._fetched_ns - _FETCH_INTERVAL_NS)
            self._timer_errors.record(late_ns)
            self._overruns += late_ns // _FETCH_INTERVAL_NS
        self._fetched_ns = now

    def _describe(self, bag: BagWriter, at_end: bool) -> None:
        """Attach the nodes' parameters and map as soon as all nodes have answered, at the latest when the bag ends, and
        then note what changes."""
        values = dict(self._remote.values)
        if self._described is not None and self._described[0] is bag:
            note_changes(bag, time.time_ns(), self._described[1], values)
        elif self._remote.complete or at_end:
            refusal = attach_parameters(bag, values)
            if refusal and self._expects_map:
                self.node.get_logger().warning(refusal)
            elif refusal:
                self.node.get_logger().info(refusal)
        else:
            return
        self._described = bag, values

    def _watch(self) -> None:
        failure = self._recorder.failure
        if failure is None:
            return
        try:
            # Finish the bag here: close() would report the failure once more.
            self._recorder.stop()
        except RUN_FAILURES as error:
            failure = error
        self.node.fail(failure)

    def _counters(self) -> dict[str, object]:
        recorder = self._recorder
        counters: dict[str, object] = {
            SAMPLES: self._samples,
            LOST: self._gaps.lost,
            OVERRUNS: self._overruns,
            "recording": recorder.recording,
            "received": self._received,
            "written": recorder.written,
            "dropped": recorder.intake.dropped,
            "queued": len(recorder.intake.queue),
            UNCONNECTED: " ".join(topic for topic, queue in self._topics.items() if not queue.connected),
            **written(TIMER_ERROR, self._timer_errors.take()),
        }
        if recorder.failure:
            counters["error"] = f"recording stopped: {recorder.failure}"
        return counters

    def close(self) -> None:
        """Write the messages that have arrived, attach the parameters, finish the bag, pack the incidents that wait."""
        self._finish()
        if self._incidents:
            self._incidents.close()


def chosen_topics(text: str) -> frozenset[str]:
    """The topics of this package, as in the contract, that the parameter ``topics`` chooses; none by an empty text.
    Raises ParameterError when another text chooses none."""
    recorded = [*(stream.topic for stream in (*STREAMS, DISPLACEMENT)), STAGE_TRAJECTORY, DIAGNOSTICS]
    pattern = _pattern("topics", text)
    chosen = frozenset(topic for topic in recorded if pattern.fullmatch(topic.lstrip("/")))
    if text and not chosen:
        names = ", ".join(topic.lstrip("/") for topic in recorded)
        raise ParameterError(
            f"parameter 'topics': {text!r} matches no topic; allowed: a regular expression for some of {names}, or "
            "empty for none; 'other_topics' has all further ones, by their full names"
        )
    return chosen


def _pattern(name: str, text: str) -> re.Pattern[str]:
    try:
        return re.compile(text)
    except re.error as error:
        raise ParameterError(f"parameter '{name}': {text!r}: {error}; allowed: a regular expression") from error


LOGGER = "logger", LoggerNodeParameters, LoggerComponent
main = partial(run_managed, [LOGGER])
"""Entry point of `ros2 run straightcomp_ros logger_node`."""
