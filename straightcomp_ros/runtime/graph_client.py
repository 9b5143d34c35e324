"""A node's access to the others of its graph, without waiting: it requests what they are to do, and observes them.

It reads batches and slow topics only, which costs the publishing loops almost nothing.
"""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import qos_profile_parameter_events
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from straightcomp_ros.cell.cell_sequence import Answer
from straightcomp_ros.cell.observation import ABSENT, PLAIN, SILENT, STARTING, Observation, StrokeErrors
from straightcomp_ros.contract import (
    ALWAYS_PUBLISHED,
    CONTROLLER_STATE,
    DIAGNOSTICS,
    DRIVER_STATE,
    HEARTBEAT,
    POSITION,
    SAFETY_STATE,
    STAGE,
    STAGE_STATE,
    STAGE_TRAJECTORY,
    UNCONNECTED,
    Stream,
)
from straightcomp_ros.messages.cdr import NANOSECONDS
from straightcomp_ros.model.motion import Waypoint
from straightcomp_ros.model.paced_motion import StageState
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS
from straightcomp_ros.runtime.safety_panel import LATCHED, CommissioningWatch, SafetyState
from straightcomp_ros.runtime.stage_state import stage_state
from straightcomp_ros.runtime.streams import Streams
from straightcomp_ros.safety.faults import one_line
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.timing.node_timing import (
    DESCRIPTION,
    EXCITATION,
    EXCITING,
    LOST,
    SAMPLES,
    UNREFERENCED,
    count,
    reporting_node,
)

_TICK_S = 0.05
_LOOK_EVERY_S = 0.5
_BUSY_S = 0.3
"""A node without a heartbeat for this time, of ten in a second, is in the transition that it was asked for."""
_WARN_EVERY_S = 5.0
_REPORT_LASTS_S = 5.0
_LONGEST_VALUE = 4000
_MOST_WAITING = 4
_YIELD_EVERY = 64
_UPWARDS = {"unconfigured": Transition.TRANSITION_CONFIGURE, "inactive": Transition.TRANSITION_ACTIVATE}
_PARAMETERS_EVERY_S, _PARAMETER_EVENTS = 0.25, "/parameter_events"
_AGAIN_AFTER = 8
"""Looks until a node is asked again: a response is lost if the node receives the request before it knows the client."""
_DRIVER, _ACTIVE = "driver", "active"
_ENABLE = "driver/enable"
_SERVICES = {
    SetBool: (_ENABLE, "driver/hold", "feedforward/center"),
    Trigger: ("driver/reset_fault", "driver/end_motion", "driver/home", "feedforward/reload_map"),
}
"""What is asked of the nodes. Their clients are made at the start: a response is lost if a node receives the request
before it knows the client."""
_ERROR = CONTROLLER_STATE.layout.columns.index("error")
_SIGMA = CONTROLLER_STATE.layout.columns.index("sliding_variable")
Messages = Sequence[tuple[int, Sequence[float], int]]
"""As :meth:`SubscriptionQueue.fetch` returns them."""


def _ignored(refusal: str) -> None:
    pass


class Heartbeats:
    """Which nodes are alive. A node is silent until its first heartbeat, and again ``timeout`` s after its last one.

    Attributes:
        ages: time in s since each node's last heartbeat; from the timeout on it is silent.
        states: lifecycle state of each node by its last heartbeat; empty before the first.
    """

    def __init__(self, node: Node, names: Sequence[str], timeout: float = 1.0) -> None:
        self._timeout = timeout
        self.ages = dict.fromkeys(names, timeout)
        self.states = dict.fromkeys(names, "")
        self._ticked = time.monotonic()
        node.create_subscription(DiagnosticStatus, HEARTBEAT, self._on_heartbeat, 100)
        node.create_timer(_TICK_S, self._tick)

    def silent(self, seconds: float | None = None) -> list[str]:
        """Nodes without a heartbeat within the timeout, or within ``seconds``."""
        limit = self._timeout if seconds is None else seconds
        return [name for name, age in self.ages.items() if age >= limit]

    def _tick(self) -> None:
        # A process that was suspended must not mistake its own pause for silence of the nodes.
        now = time.monotonic()
        passed, self._ticked = min(now - self._ticked, 2.0 * _TICK_S), now
        for name in self.ages:
            self.ages[name] += passed

    def _on_heartbeat(self, message: DiagnosticStatus) -> None:
        if message.name in self.ages:
            self.ages[message.name] = 0.0
            self.states[message.name] = message.message


class GraphClient:
    """Requests to the nodes ``names`` in ``node``'s namespace (see the sequencer's `Machine`), and their observation.

    A request calls ``then`` with the reason for a refusal, or an empty text. An executor must spin ``node``.

    Args:
        batches: streams to read from their batches, as errors and σ of `controller_state`, besides the position.
        fresh: time after the last sample for which the observation is fresh, s.
        patient: the observation is also fresh before the first sample, until :meth:`expect_samples` is called.
        stage: its description, by which ``node`` itself moves it; None if it does not.
        silent_after: time in s after its last heartbeat from which a node counts as silent.

    Attributes:
        commissioning: what another client that commissions the machine is doing.
        safety: the driver's newest safety state.
        strokes: the error of each movement of the stage.
    """

    def __init__(
        self,
        node: Node,
        names: Sequence[str],
        *,
        batches: Iterable[Stream] = (CONTROLLER_STATE, DRIVER_STATE),
        fresh: float = 0.5,
        patient: bool = False,
        stage: StageParameters | None = None,
        silent_after: float = 5.0,
    ) -> None:
        self.node, self._fresh = node, fresh
        self.safety, self._reported_off = SafetyState(), False
        self._clients: dict[str, ServiceClient] = {}
        for kind, names_of_kind in _SERVICES.items():
            for name in names_of_kind:
                self.service(kind, name)
        self._set_driver = self.service(SetParameters, "driver/set_parameters")
        self.stage = StageState()
        self._change_state = {name: self.service(ChangeState, f"{name}/change_state") for name in names}
        self._trajectory = node.create_publisher(JointTrajectory, STAGE_TRAJECTORY, 10)
        self._heartbeats = Heartbeats(node, names, silent_after)
        self.commissioning = CommissioningWatch(node)
        self._present: set[str] = set()
        node.create_timer(_LOOK_EVERY_S, self._look)
        self.streams = Streams(node)
        self._queues = {POSITION: self.streams.queue(POSITION)}
        self._queues |= {stream: self.streams.batches(stream) for stream in batches}
        node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, 10)
        node.create_subscription(DiagnosticStatus, SAFETY_STATE, self._on_safety_state, LATCHED)
        node.create_subscription(DiagnosticStatus, STAGE_STATE, self._on_stage_state, LATCHED)
        self.strokes, self._own = StrokeErrors(), dict[str, str]()
        if stage is not None:
            self._own[node.get_name()] = stage.identity
            self.strokes.expect(stage.motion.speed, stage.encoder.x_resolution)
        self._newest = Observation()
        self._last_came = math.inf if patient else -math.inf
        self._reports: dict[str, tuple[float, str | None, dict[str, str]]] = {}

    def service(self, kind: Any, name: str) -> ServiceClient:
        """The client of a service."""
        if name not in self._clients:
            self._clients[name] = ServiceClient(self.node, kind, name)
        return self._clients[name]

    @property
    def states(self) -> dict[str, str]:
        """State of each node: ``absent``; ``plain`` if it has no lifecycle; without heartbeats ``silent``, or
        ``starting`` where it was not active before; else its lifecycle state in lower case."""
        before = self._heartbeats.states
        quiet = {name: SILENT if before[name] == _ACTIVE else STARTING for name in self._heartbeats.silent()}
        states = before | quiet
        states |= {name: PLAIN for name, change in self._change_state.items() if not change.ready}
        return states | {name: ABSENT for name in states if name not in self._present}

    def quiet(self, seconds: float) -> bool:
        """Whether a node has had no heartbeat for ``seconds`` since it had one."""
        return any(self._heartbeats.states[name] for name in self._heartbeats.silent(seconds))

    @property
    def stage_listens(self) -> bool:
        """Whether a node subscribes to the stage's trajectory."""
        return bool(self._trajectory.get_subscription_count())

    @property
    def obstacle(self) -> str:
        """Why the stage cannot be moved or the amplifier cannot be switched; empty if both can."""
        if not self.stage_listens:
            return "no node subscribes to the stage's trajectory"
        return "" if self._clients[_ENABLE].ready else "the driver's service 'enable' is not available"

    def activate(self) -> None:
        """Request one transition towards active of each node that is unconfigured or inactive, and not busy."""
        busy = self._heartbeats.silent(_BUSY_S)
        for name, state in self.states.items():
            if state in _UPWARDS and name not in busy:
                request = ChangeState.Request(transition=Transition(id=_UPWARDS[state]))
                self._change_state[name].call(request, partial(self._changed, name, state))

    def _changed(self, name: str, state: str, response: ChangeState.Response) -> None:
        if not response.success:
            words = f"{name} did not leave the state '{state}'; its log says why"
            self.node.get_logger().warning(words, throttle_duration_sec=_WARN_EVERY_S)

    def request(self, service: str, on: bool | None = None, then: Answer = _ignored) -> None:
        """Call one of :data:`_SERVICES`, with the data ``on`` if it is a SetBool."""
        self._clients[service].ask(Trigger.Request() if on is None else SetBool.Request(data=on), then)

    def leave(self) -> Future:
        """Switch off at the end of the client. The future's result is an empty text once the driver has done so or
        reports the amplifier off, as a driver does that ends at the same moment; otherwise why it is not off."""
        left = Future()

        def answered(refusal: str) -> None:
            if not left.done():
                left.set_result("" if self._reported_off else refusal)

        def look() -> None:
            if self._reported_off or not self._clients[_ENABLE].ready:
                answered("the driver has left the graph")

        self.request(_ENABLE, False, answered)
        self.node.create_timer(_TICK_S, look)
        return left

    def move(self, waypoints: Sequence[Waypoint]) -> None:
        """Move the stage along ``waypoints``, from now."""
        self._trajectory.publish(message_from_waypoints(waypoints))

    def override(self, fraction: float, then: Answer = _ignored) -> None:
        if not self._set_driver.ready:
            then("the driver's parameters are not available")
            return
        asked = Parameter("override", value=fraction).to_parameter_msg()

        def answered(response: SetParameters.Response) -> None:
            (result,) = response.results
            then("" if result.successful else result.reason or "refused")

        self._set_driver.call(SetParameters.Request(parameters=[asked]), answered)

    def expect_samples(self) -> None:
        """Count the absence of a first sample as silence from now on."""
        self._last_came = min(self._last_came, time.monotonic())

    def fetch(self) -> Mapping[Stream, Messages]:
        """Take the messages that have arrived; call it at least ten times a second."""
        fetched: dict[Stream, Messages] = {stream: queue.fetch() for stream, queue in self._queues.items()}
        positions, controller = fetched[POSITION], fetched.get(CONTROLLER_STATE, ())
        self.strokes.add(
            ((stamp_ns, x) for stamp_ns, (x, _), _ in _giving_way(positions)),
            ((stamp_ns, numbers[_ERROR]) for stamp_ns, numbers, _ in _giving_way(controller)),
        )
        seen = self._newest
        if positions:
            x, y = positions[-1][1]
            seen = replace(seen, x=x, y=y)
        if controller:
            numbers = controller[-1][1]
            seen = replace(seen, error=numbers[_ERROR], sliding_variable=numbers[_SIGMA])
        for messages in (fetched.get(DRIVER_STATE), positions):
            if messages:
                seen = replace(seen, stamp_ns=messages[-1][0], first_ns=seen.first_ns or messages[0][0])
                self._last_came = time.monotonic()
        self._newest = seen
        return fetched

    def reports(self) -> dict[str, dict[str, str]]:
        """Values of each node's newest diagnostics, without the nodes that have fallen silent."""
        oldest = time.monotonic() - _REPORT_LASTS_S
        return {node: values for node, (came, _, values) in self._reports.items() if came > oldest}

    def observation(self) -> Observation:
        """The graph now."""
        fresh = time.monotonic() - self._last_came < self._fresh
        states, reports = self.states, self.reports()
        controller = reports.get("controller", {})
        reporting = states.get(_DRIVER) not in (ABSENT, STARTING, SILENT)
        # A fault of the driver is in its safety state at once, but in its diagnostics up to a second later.
        safety = self.safety if reporting else SafetyState()
        errors = {node: error for node, (_, error, _) in self._reports.items() if error is not None}
        faults = {node: error for node, error in errors.items() if node in reports and node != _DRIVER}
        reported = {node: values[DESCRIPTION] for node, values in reports.items() if DESCRIPTION in values}
        return replace(
            self._newest,
            nodes=states,
            faults=faults | ({_DRIVER: safety.fault} if safety.fault else {}),
            fault_code=safety.code,
            unrecorded=self._unrecorded(reports) if "logger" in states else (),
            descriptions=self._own | reported,
            fresh=fresh,
            commissioning=self.commissioning.doing or ("excitation" if controller.get(EXCITATION) == EXCITING else ""),
            amplifier_on=fresh and self.safety.amplifier_on,
            unreferenced=reports.get(_DRIVER, {}).get(UNREFERENCED, ""),
            stage=self.stage if reporting else self.stage._replace(condition=""),
            still=self.strokes.still,
            stroke_error_pp=self.strokes.last_pp,
            samples=count(controller, SAMPLES),
            lost_samples=count(controller, LOST),
        )

    def _unrecorded(self, reports: Mapping[str, Mapping[str, str]]) -> tuple[str, ...]:
        unconnected = reports.get("logger", {}).get(UNCONNECTED)
        if unconnected is None:
            return ("all topics",)
        wanted = {self.node.resolve_topic_name(stream.topic) for stream in ALWAYS_PUBLISHED}
        return tuple(sorted(wanted.intersection(unconnected.split())))

    def _on_safety_state(self, message: DiagnosticStatus) -> None:
        self.safety = SafetyState.of(message)
        self._reported_off = not self.safety.amplifier_on

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = reporting_node(status.name, self.node.get_namespace())
            # Each name stays in memory, and any program may publish here.
            if name in NODE_PARAMETERS:
                error = one_line(status.message) if status.level == DiagnosticStatus.ERROR else None
                self._reports[name] = (
                    time.monotonic(),
                    error,
                    {value.key: one_line(value.value, _LONGEST_VALUE) for value in status.values},
                )

    def _on_stage_state(self, message: DiagnosticStatus) -> None:
        self.stage = stage_state(message)

    def _look(self) -> None:
        here = self.node.get_namespace()
        self._present = {name for name, place in self.node.get_node_names_and_namespaces() if place == here}


def _giving_way(messages: Messages) -> Iterator[tuple[int, Sequence[float], int]]:
    """The messages; nodes of the same real-time priority would otherwise wait until the loop over all of them ends."""
    for number, message in enumerate(messages, 1):
        yield message
        if number % _YIELD_EVERY == 0 or number == len(messages):
            os.sched_yield()


class ServiceClient:
    """Calls one service. It waits for the answers to the newest requests only, instead of collecting all of them."""

    def __init__(self, node: Node, kind: Any, name: str) -> None:
        self._client = node.create_client(kind, name)
        self._newest: deque[Future] = deque()

    @property
    def ready(self) -> bool:
        """Whether the service is available."""
        return bool(self._client.service_is_ready())

    def ask(self, request: Any, then: Answer) -> None:
        """Call a service that answers with ``success`` and ``message``; ``then`` gets its refusal, or an empty text."""
        if self.ready:
            self.call(request, lambda response: then("" if response.success else response.message or "refused"))
        else:
            then(f"service {self._client.srv_name} is not available")

    def call(self, request: Any, then: Callable[[Any], None] = lambda response: None) -> Future:
        """Call the service; ``then`` gets its response, and so does the future."""
        future = self._client.call_async(request)
        future.add_done_callback(lambda done: then(done.result()))
        self._newest.append(future)
        if len(self._newest) > _MOST_WAITING:
            self._client.remove_pending_request(self._newest.popleft())
        return future


class RemoteParameters:
    """All parameters of the nodes ``names``, as they are now: each node is asked when it is available, and anew when it
    was started again; what is set later is received. A name without a first slash is one in this node's namespace.

    Attributes:
        values: the parameters by node, as ``names`` has it, and dotted name.
    """

    def __init__(self, node: Node, names: Sequence[str]) -> None:
        self.values: dict[str, dict[str, object]] = {}
        self._node = node
        self._clients = {name: AsyncParameterClient(node, name) for name in names}
        own = node.get_namespace().rstrip("/")
        self._names = {name if name.startswith("/") else f"{own}/{name}": name for name in names}
        self._looks_left = dict.fromkeys(names, 0)
        self._answered: dict[str, set[bytes]] = {}
        """Of each node that has answered, its processes at that time."""
        node.create_timer(_PARAMETERS_EVERY_S, self._look)
        node.create_subscription(ParameterEvent, _PARAMETER_EVENTS, self._on_event, qos_profile_parameter_events)

    def ask_again(self) -> None:
        """Ask all nodes anew."""
        self._answered.clear()
        self._looks_left = dict.fromkeys(self._clients, 0)

    def _look(self) -> None:
        processes: dict[str, set[bytes]] = {name: set() for name in self._clients}
        for one in self._node.get_publishers_info_by_topic(_PARAMETER_EVENTS):
            if name := self._names.get(f"{one.node_namespace.rstrip('/')}/{one.node_name}"):
                processes[name].add(bytes(one.endpoint_gid))
        for name, client in self._clients.items():
            if name in self._answered and processes[name] <= self._answered[name]:
                continue
            self._answered.pop(name, None)
            self._looks_left[name] -= 1
            if self._looks_left[name] < 0 and client.services_are_ready():
                self._looks_left[name] = _AGAIN_AFTER
                self._collect(name, processes[name], client)

    def _collect(self, node: str, processes: set[bytes], client: AsyncParameterClient) -> None:
        def listed(future: Future) -> None:
            names = list(future.result().result.names)

            def got(answer: Future) -> None:
                values = answer.result().values
                # Not so many after a parameter was undeclared meanwhile: ask again.
                if len(values) == len(names):
                    self.values[node] = dict(zip(names, map(parameter_value_to_python, values), strict=True))
                    self._answered[node], self._looks_left[node] = processes, 0

            client.get_parameters(names).add_done_callback(got)

        client.list_parameters([], 10).add_done_callback(listed)

    def _on_event(self, event: ParameterEvent) -> None:
        name = self._names.get(event.node, "")
        if name in self.values:
            deleted = {one.name for one in event.deleted_parameters}
            kept = {key: value for key, value in self.values[name].items() if key not in deleted}
            given = (*event.new_parameters, *event.changed_parameters)
            # Replaced as a whole: another thread may be reading it.
            self.values[name] = kept | {one.name: parameter_value_to_python(one.value) for one in given}

    @property
    def complete(self) -> bool:
        """Whether all nodes have answered."""
        return len(self._answered) == len(self._clients)


def message_from_waypoints(waypoints: Sequence[Waypoint]) -> JointTrajectory:
    """The stage's trajectory, with one point for each waypoint; stamp zero: it starts when it arrives."""
    points = []
    for time_ns, position, velocity in waypoints:
        sec, nanosec = divmod(time_ns, NANOSECONDS)
        after = Duration(sec=sec, nanosec=nanosec)
        points.append(JointTrajectoryPoint(positions=[position], velocities=[velocity], time_from_start=after))
    return JointTrajectory(joint_names=[STAGE], points=points)
