"""A node's requests to the others of its graph, without waiting: lifecycle, amplifier, faults, motion, parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from builtin_interfaces.msg import Duration
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from straightcomp_ros.cell.observation import ABSENT, PLAIN, SILENT
from straightcomp_ros.contract import STAGE, STAGE_TRAJECTORY
from straightcomp_ros.messages.cdr import NANOSECONDS
from straightcomp_ros.model.motion import Waypoint
from straightcomp_ros.runtime.commissioning_client import CommissioningWatch
from straightcomp_ros.runtime.graph_watch import Heartbeats

_LOOK_EVERY_S = 0.5
_WARN_EVERY_S = 5.0
_MOST_WAITING = 4
_UPWARDS = {"unconfigured": Transition.TRANSITION_CONFIGURE, "inactive": Transition.TRANSITION_ACTIVATE}
_PARAMETERS_EVERY_S = 0.25
_AGAIN_AFTER = 8
"""Looks until a node is asked again: a response is lost if the node receives the request before it knows the client."""
Answer = Callable[[str], None]
"""Called with the reason for a refusal; an empty text means success."""


def _ignored(refusal: str) -> None:
    pass


class GraphClient:
    """Calls services of the nodes ``names`` in ``node``'s namespace: see the sequencer's `Machine`.

    ``then`` is called with the reason for a refusal, or an empty text. A node counts as silent ``silent_after`` seconds
    after its last heartbeat.

    Attributes:
        refusal: why the amplifier was not switched on by the last request; empty if it was.
    """

    def __init__(self, node: Node, names: Sequence[str], silent_after: float = 5.0) -> None:
        self._node = node
        self.refusal = ""
        self._clients: dict[str, ServiceClient] = {}
        self._enable = self.service(SetBool, "driver/enable")
        self._reset = self.service(Trigger, "driver/reset_fault")
        self._reload_map = self.service(Trigger, "feedforward/reload_map")
        self._center = self.service(SetBool, "feedforward/center")
        self._change_state = {name: self.service(ChangeState, f"{name}/change_state") for name in names}
        self._trajectory = node.create_publisher(JointTrajectory, STAGE_TRAJECTORY, 10)
        self._heartbeats = Heartbeats(node, names, silent_after)
        self._commissioning = CommissioningWatch(node)
        self._present: set[str] = set()
        node.create_timer(_LOOK_EVERY_S, self._look)

    def service(self, kind: Any, name: str) -> ServiceClient:
        """The client of a service."""
        if name not in self._clients:
            self._clients[name] = ServiceClient(self._node, kind, name)
        return self._clients[name]

    @property
    def states(self) -> dict[str, str]:
        """State of each node: ``absent``; ``plain`` if it has no lifecycle; ``silent`` without heartbeats; else its
        lifecycle state in lower case."""
        states = self._heartbeats.states | dict.fromkeys(self._heartbeats.silent(), SILENT)
        states |= {name: PLAIN for name, change in self._change_state.items() if not change.ready}
        return states | {name: ABSENT for name in states if name not in self._present}

    def quiet(self, seconds: float) -> bool:
        """Whether a node has had no heartbeat for ``seconds`` since it had one."""
        return any(self._heartbeats.states[name] for name in self._heartbeats.silent(seconds))

    @property
    def commissioning(self) -> str:
        """What a client that commissions the machine is doing; empty without one."""
        return self._commissioning.doing

    @property
    def stage_listens(self) -> bool:
        """Whether a node subscribes to the stage's trajectory."""
        return bool(self._trajectory.get_subscription_count())

    @property
    def obstacle(self) -> str:
        """Why the stage cannot be moved or the amplifier cannot be switched; empty if both can."""
        if not self.stage_listens:
            return "no node subscribes to the stage's trajectory"
        return "" if self._enable.ready else "the driver's service 'enable' is not available"

    def activate(self) -> None:
        """Request one transition towards active of each node that is unconfigured or inactive."""
        for name, state in self.states.items():
            if state in _UPWARDS:
                request = ChangeState.Request(transition=Transition(id=_UPWARDS[state]))
                self._change_state[name].call(request, partial(self._changed, name, state))

    def _changed(self, name: str, state: str, response: ChangeState.Response) -> None:
        if not response.success:
            words = f"{name} did not leave the state '{state}'; its log says why"
            self._node.get_logger().warning(words, throttle_duration_sec=_WARN_EVERY_S)

    def switch_on(self, then: Answer = _ignored) -> None:
        self.refusal = ""

        def answered(refusal: str) -> None:
            self.refusal = refusal
            then(refusal)

        self._enable.ask(SetBool.Request(data=True), answered)

    def switch_off(self, then: Answer = _ignored) -> None:
        self._enable.ask(SetBool.Request(data=False), then)

    def leave(self) -> Future:
        """Switch off at the end of the client; the future's result is the reason for a refusal, or an empty text."""
        left = Future()
        self.switch_off(left.set_result)
        return left

    def reset_faults(self, then: Answer = _ignored) -> None:
        self._reset.ask(Trigger.Request(), then)

    def reload_map(self, then: Answer) -> None:
        self._reload_map.ask(Trigger.Request(), then)

    def center(self, middle: bool, then: Answer) -> None:
        self._center.ask(SetBool.Request(data=middle), then)

    def move(self, waypoints: Sequence[Waypoint]) -> None:
        """Move the stage along ``waypoints``, from now."""
        self._trajectory.publish(message_from_waypoints(waypoints))

    def _look(self) -> None:
        here = self._node.get_namespace()
        self._present = {name for name, place in self._node.get_node_names_and_namespaces() if place == here}


class ServiceClient:
    """Calls one service. It drops the oldest unanswered requests instead of collecting them without limit."""

    def __init__(self, node: Node, kind: Any, name: str) -> None:
        self._client = node.create_client(kind, name)
        self._waiting: list[Future] = []

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

        def answered(future: Future) -> None:
            if future in self._waiting:
                self._waiting.remove(future)
                then(future.result())

        future = self._client.call_async(request)
        self._waiting.append(future)
        future.add_done_callback(answered)
        while len(self._waiting) > _MOST_WAITING:
            self._client.remove_pending_request(self._waiting.pop(0))
        return future


class RemoteParameters:
    """Asks each of the nodes ``names`` in this node's namespace, when it is available, for all its parameters.

    Attributes:
        values: the parameters by node and dotted name.
    """

    def __init__(self, node: Node, names: Sequence[str]) -> None:
        self.values: dict[str, dict[str, object]] = {}
        self._clients = {name: AsyncParameterClient(node, name) for name in names}
        self._looks_left = dict.fromkeys(names, 0)
        self._timer = node.create_timer(_PARAMETERS_EVERY_S, self._look)

    def _look(self) -> None:
        for name in [name for name in self._clients if name not in self.values]:
            self._looks_left[name] -= 1
            if self._looks_left[name] < 0 and self._clients[name].services_are_ready():
                self._looks_left[name] = _AGAIN_AFTER
                self._collect(name, self._clients[name])
        if self.complete:
            self._timer.cancel()

    def _collect(self, node: str, client: AsyncParameterClient) -> None:
        def listed(future: Future) -> None:
            names = list(future.result().result.names)

            def got(answer: Future) -> None:
                values = answer.result().values
                # Not so many after a parameter was undeclared meanwhile: ask again.
                if len(values) == len(names):
                    self.values[node] = dict(zip(names, map(parameter_value_to_python, values), strict=True))

            client.get_parameters(names).add_done_callback(got)

        client.list_parameters([], 10).add_done_callback(listed)

    @property
    def complete(self) -> bool:
        """Whether all nodes have answered."""
        return len(self.values) == len(self._clients)


def message_from_waypoints(waypoints: Sequence[Waypoint]) -> JointTrajectory:
    """The stage's trajectory, with one point for each waypoint; stamp zero: it starts when it arrives."""
    points = []
    for time_ns, position, velocity in waypoints:
        sec, nanosec = divmod(time_ns, NANOSECONDS)
        after = Duration(sec=sec, nanosec=nanosec)
        points.append(JointTrajectoryPoint(positions=[position], velocities=[velocity], time_from_start=after))
    return JointTrajectory(joint_names=[STAGE], points=points)
