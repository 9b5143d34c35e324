"""What the cell node, the gateway and the view request from the graph: lifecycle, amplifier, faults, stage motion."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.cell.observation import ABSENT, PLAIN, SILENT
from straightcomp_ros.contract import STAGE_TRAJECTORY
from straightcomp_ros.model.motion import Waypoint
from straightcomp_ros.runtime.commissioning_client import CommissioningWatch
from straightcomp_ros.runtime.heartbeats import Heartbeats
from straightcomp_ros.runtime.stage_trajectory import message_from_waypoints

_LOOK_EVERY_S = 0.5
_WARN_EVERY_S = 5.0
_MOST_WAITING = 4
_UPWARDS = {"unconfigured": Transition.TRANSITION_CONFIGURE, "inactive": Transition.TRANSITION_ACTIVATE}
Answer = Callable[[str], None]
"""Called with the reason for a refusal; an empty text means success."""


class GraphServices:
    """Calls services of the nodes ``names`` in ``node``'s namespace without waiting: see the sequencer's `Machine`.

    ``then`` is called with the reason for a refusal, or an empty text. A node counts as silent ``silent_after`` seconds
    after its last heartbeat.
    """

    def __init__(self, node: Node, names: Sequence[str], silent_after: float = 5.0) -> None:
        self._node = node
        self.refusal = ""
        self._enable = _Caller(node, SetBool, "driver/enable")
        self._reset = _Caller(node, Trigger, "driver/reset_fault")
        self._reload_map = _Caller(node, Trigger, "feedforward/reload_map")
        self._center = _Caller(node, SetBool, "feedforward/center")
        self._change_state = {name: _Caller(node, ChangeState, f"{name}/change_state") for name in names}
        self._trajectory = node.create_publisher(JointTrajectory, STAGE_TRAJECTORY, 10)
        self._heartbeats = Heartbeats(node, names, silent_after)
        self._commissioning = CommissioningWatch(node)
        self._present: set[str] = set()
        node.create_timer(_LOOK_EVERY_S, self._look)

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
    def obstacle(self) -> str:
        """Why the stage cannot be moved or the amplifier cannot be switched; empty if both can."""
        if not self._trajectory.get_subscription_count():
            return "no node subscribes to the stage's trajectory"
        return "" if self._enable.ready else "the driver's service 'enable' is not available"

    def activate(self) -> None:
        """Request one transition towards active of each node that is unconfigured or inactive."""
        for name, state in self.states.items():
            if state in _UPWARDS:
                request = ChangeState.Request(transition=Transition(id=_UPWARDS[state]))
                self._change_state[name](request, partial(self._changed, name, state))

    def _changed(self, name: str, state: str, response: ChangeState.Response) -> None:
        if not response.success:
            words = f"{name} did not leave the state '{state}'; its log says why"
            self._node.get_logger().warning(words, throttle_duration_sec=_WARN_EVERY_S)

    def switch_on(self, then: Answer = lambda refusal: None) -> None:
        self.refusal = ""

        def answered(refusal: str) -> None:
            self.refusal = refusal
            then(refusal)

        self._enable.ask(SetBool.Request(data=True), answered)

    def switch_off(self, then: Answer = lambda refusal: None) -> None:
        self._enable.ask(SetBool.Request(data=False), then)

    def leave(self) -> Future:
        """Switch off at the end of the client; the future's result is the reason for a refusal, or an empty text."""
        left = Future()
        self.switch_off(left.set_result)
        return left

    def reset_faults(self, then: Answer = lambda refusal: None) -> None:
        self._reset.ask(Trigger.Request(), then)

    def reload_map(self, then: Answer) -> None:
        self._reload_map.ask(Trigger.Request(), then)

    def center(self, middle: bool, then: Answer) -> None:
        self._center.ask(SetBool.Request(data=middle), then)

    def move(self, waypoints: Sequence[Waypoint]) -> None:
        self._trajectory.publish(message_from_waypoints(waypoints))

    def _look(self) -> None:
        here = self._node.get_namespace()
        self._present = {name for name, place in self._node.get_node_names_and_namespaces() if place == here}


class _Caller:
    """Calls one service. It drops the oldest unanswered requests instead of collecting them without limit."""

    def __init__(self, node: Node, kind: Any, name: str) -> None:
        self._client = node.create_client(kind, name)
        self._waiting: list[Future] = []

    @property
    def ready(self) -> bool:
        return bool(self._client.service_is_ready())

    def ask(self, request: Any, then: Answer) -> None:
        """Call a service that answers with ``success`` and ``message``; ``then`` gets its refusal, or an empty text."""
        if self.ready:
            self(request, lambda response: then("" if response.success else response.message or "refused"))
        else:
            then(f"service {self._client.srv_name} is not available")

    def __call__(self, request: Any, then: Callable[[Any], None]) -> None:
        def answered(future: Future) -> None:
            if future in self._waiting:
                self._waiting.remove(future)
                then(future.result())

        self._waiting.append(self._client.call_async(request))
        self._waiting[-1].add_done_callback(answered)
        while len(self._waiting) > _MOST_WAITING:
            self._client.remove_pending_request(self._waiting.pop(0))
