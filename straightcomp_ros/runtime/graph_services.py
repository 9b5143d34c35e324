"""The graph's services as the gateway and the view use them: lifecycle, amplifier, faults, motion of the stage.

Whatever the nodes call their services is written here and in no other module of those two.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.cell.observation import ABSENT, SILENT
from straightcomp_ros.contract import STAGE_TRAJECTORY
from straightcomp_ros.model.stage import Waypoint
from straightcomp_ros.runtime.stage_trajectory import message_from_waypoints

_LOOK_EVERY_S = 0.5
_SILENT_AFTER_S = 5.0
_MOST_WAITING = 4
_PLAIN = "plain"
_UPWARDS: Mapping[int, int] = {
    State.PRIMARY_STATE_UNCONFIGURED: Transition.TRANSITION_CONFIGURE,
    State.PRIMARY_STATE_INACTIVE: Transition.TRANSITION_ACTIVATE,
}


Answer = Callable[[str], None]
"""Takes why something was refused, or an empty text."""


class GraphServices:
    """Asks without waiting, and keeps the answers.

    Args:
        node: asks.
        names: nodes of the graph, in this node's namespace.

    Attributes:
        refusal: why the amplifier was not switched on when that was asked last; empty while not answered.
    """

    def __init__(self, node: Node, names: Sequence[str]) -> None:
        self._node = node
        self.refusal = ""
        self._enable = _Caller(node, SetBool, "driver/enable")
        self._reset = _Caller(node, Trigger, "driver/reset_fault")
        self._reload_map = _Caller(node, Trigger, "feedforward/reload_map")
        self._center = _Caller(node, SetBool, "feedforward/center")
        self._trajectory = node.create_publisher(JointTrajectory, STAGE_TRAJECTORY, 10)
        self._lifecycles = {name: _Lifecycle(node, name) for name in names}
        self._present: set[str] = set()
        node.create_timer(_LOOK_EVERY_S, self._look)

    @property
    def states(self) -> dict[str, str]:
        """State of each node: ``absent``; ``plain`` where it has no lifecycle; ``silent`` where it does not answer;
        else its lifecycle state in lower case."""
        return {
            name: lifecycle.state if name in self._present else ABSENT for name, lifecycle in self._lifecycles.items()
        }

    def activate(self) -> None:
        """One transition towards active for each node that is unconfigured or inactive."""
        for lifecycle in self._lifecycles.values():
            lifecycle.rise()

    def switch_on(self, then: Answer = lambda refusal: None) -> None:
        """Ask for the amplifier; ``then`` gets why that was refused, or an empty text."""
        self.refusal = ""

        def answered(refusal: str) -> None:
            self.refusal = refusal
            then(refusal)

        self._enable.ask(SetBool.Request(data=True), answered)

    def switch_off(self, then: Answer = lambda refusal: None) -> None:
        """Switch the amplifier off."""
        self._enable.ask(SetBool.Request(data=False), then)

    def reset_faults(self, then: Answer = lambda refusal: None) -> None:
        """Clear what is latched."""
        self._reset.ask(Trigger.Request(), then)

    def reload_map(self, then: Answer) -> None:
        """Read the map's file again."""
        self._reload_map.ask(Trigger.Request(), then)

    def center(self, middle: bool, then: Answer) -> None:
        """Take the reference to the middle of the travel, or back to the map."""
        self._center.ask(SetBool.Request(data=middle), then)

    def move(self, waypoints: Sequence[Waypoint]) -> None:
        """Move the stage, starting when this arrives."""
        self._trajectory.publish(message_from_waypoints(waypoints))

    def _look(self) -> None:
        here = self._node.get_namespace()
        self._present = {name for name, place in self._node.get_node_names_and_namespaces() if place == here}
        for name in self._present & self._lifecycles.keys():
            self._lifecycles[name].look()


class _Lifecycle:
    """The lifecycle of one node, if it has one."""

    def __init__(self, node: Node, name: str) -> None:
        self._get = _Caller(node, GetState, f"{name}/get_state")
        self._change = _Caller(node, ChangeState, f"{name}/change_state")
        self._id = State.PRIMARY_STATE_UNKNOWN
        self._label = ""
        self._answered = 0.0

    @property
    def state(self) -> str:
        if not self._get.ready:
            return _PLAIN
        return self._label if time.monotonic() - self._answered < _SILENT_AFTER_S else SILENT

    def look(self) -> None:
        if not self._get(GetState.Request(), self._see):
            self._id, self._label = State.PRIMARY_STATE_UNKNOWN, ""

    def rise(self) -> None:
        transition = _UPWARDS.get(self._id)
        if transition is not None:
            self._change(ChangeState.Request(transition=Transition(id=transition)))

    def _see(self, response: GetState.Response) -> None:
        self._id, self._label = response.current_state.id, response.current_state.label
        self._answered = time.monotonic()


class _Caller:
    """Calls one service. Questions that nobody answers are forgotten, not piled up."""

    def __init__(self, node: Node, kind: Any, name: str) -> None:
        self._client = node.create_client(kind, name)
        self._waiting: list[Future] = []

    @property
    def ready(self) -> bool:
        return bool(self._client.service_is_ready())

    def ask(self, request: Any, then: Answer) -> None:
        """Ask a service that answers with ``success`` and ``message``; ``then`` gets its refusal, or an empty text."""
        if not self(request, lambda response: then("" if response.success else response.message or "refused")):
            then(f"service {self._client.srv_name} is not there")

    def __call__(self, request: Any, then: Callable[[Any], None] = lambda response: None) -> bool:
        """Ask; whether the service is there. ``then`` gets the answer."""
        if not self.ready:
            return False

        def answered(future: Future) -> None:
            if future in self._waiting:
                self._waiting.remove(future)
                then(future.result())

        self._waiting.append(self._client.call_async(request))
        self._waiting[-1].add_done_callback(answered)
        while len(self._waiting) > _MOST_WAITING:
            self._client.remove_pending_request(self._waiting.pop(0))
        return True
