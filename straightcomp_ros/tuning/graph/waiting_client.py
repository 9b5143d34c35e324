"""A client that asks the nodes of a running graph and waits for their answers.

A thread of its own spins the client's node, so that the caller may compute or wait as long as it likes.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool

from straightcomp_ros.contract import COMMISSIONING_CLIENT, HEARTBEAT
from straightcomp_ros.runtime.graph_client import GraphClient, RemoteParameters
from straightcomp_ros.runtime.guarded_node import GuardedNode
from straightcomp_ros.runtime.middleware import own_profile
from straightcomp_ros.runtime.safety_panel import GONE_AFTER_S, commissioning_sign
from straightcomp_ros.tuning.commissioning import CommissioningError

ANSWER_S = 20.0
"""Longest wait for an answer: a busy computer takes long to configure a node."""
_START_S = 60.0
_LISTEN_S = 2.0 * GONE_AFTER_S
"""s in which this client learns of others: each reports that it is alive within half of it."""
_ENDED_S = _LISTEN_S + 2.0 * GONE_AFTER_S
"""s after which no node counts a client as alive that ended, or was killed, when this one began."""
_POLL_S = 0.01
_WATCH_S = 0.05
_STATES = ("unconfigured", "inactive", "active")
_UP = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
_DOWN = (None, Transition.TRANSITION_CLEANUP, Transition.TRANSITION_DEACTIVATE)
"""The transition from each of these states to the next, and to the one before."""


class WaitingClient(GraphClient):
    """Lifecycle, parameters, amplifier and motion of the graph; as a context manager it leaves ROS at its end.

    A call raises CommissioningError if a node does not answer, or refuses; the message names it and its reason.

    From :meth:`claim` on, as long as it lives, driver, cell and gateway know that a client commissions the machine.
    ``check`` raises if the graph cannot work any more.
    """

    def __init__(self, nodes: Sequence[str], namespace: str = "", check: Callable[[], object] = lambda: None) -> None:
        self._nodes, self._check = nodes, check
        with own_profile():
            rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
            # Another name than that of a node which starts such clients.
            super().__init__(GuardedNode(COMMISSIONING_CLIENT, namespace=namespace or None), nodes, batches=())
        self._remote = RemoteParameters(self.node, nodes)
        # Now, since a response is lost if the node receives the request before it knows the client.
        self.service(SetBool, "controller/excite")
        for one in nodes:
            self.service(GetState, f"{one}/get_state")
            self.service(SetParametersAtomically, f"{one}/set_parameters_atomically")
        self.node.create_timer(_WATCH_S, self.fetch)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def __enter__(self) -> WaitingClient:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown(timeout_sec=1.0)
        self._thread.join(timeout=2.0)
        # Otherwise its sign would stay until it is collected.
        self.node.destroy_node()
        rclpy.try_shutdown()

    def claim(self) -> Callable[[str], None]:
        """Announce that this client commissions the machine, unless another one does; returns a function that reports
        what it does."""
        # Once the nodes are discovered, so are their other clients: on a busy computer that takes seconds.
        self.processes()
        begin, other = time.monotonic(), self.commissioning
        while time.monotonic() < begin + _LISTEN_S or (other.doing and time.monotonic() < begin + _ENDED_S):
            time.sleep(_POLL_S)
        if other.doing:
            raise CommissioningError(f"another client commissions the machine: {other.doing}")
        # Only now: a sign of this client would count as another's.
        return commissioning_sign(self.node)

    def values(self) -> dict[str, dict[str, Any]]:
        """All parameters of the nodes as they are now, by node and dotted name."""
        self._remote.ask_again()
        self.wait(lambda: self._remote.complete, _START_S, "the nodes do not report their parameters")
        return {node: dict(section) for node, section in self._remote.values.items()}

    def processes(self) -> dict[str, str]:
        """By node, an identifier of its process: a node that is started anew has another."""
        topic, found = self.node.resolve_topic_name(HEARTBEAT), dict[str, str]()

        def all_found() -> bool:
            publishers = self.node.get_publishers_info_by_topic(topic)
            found.update({one.node_name: bytes(one.endpoint_gid).hex() for one in publishers})
            return found.keys() >= set(self._nodes)

        self.wait(all_found, _START_S, f"not all nodes publish on {topic}")
        return {node: found[node] for node in self._nodes}

    def wait(self, done: Callable[[], bool], within: float, otherwise: str) -> None:
        """Wait until ``done``; CommissioningError ``otherwise`` after ``within`` s."""
        end = time.monotonic() + within
        while not done():
            self._check()
            if time.monotonic() > end:
                raise CommissioningError(otherwise)
            time.sleep(_POLL_S)

    def bring(self, node: str, goal: str) -> None:
        """Bring ``node`` to the lifecycle state ``goal``: unconfigured, inactive or active."""
        state, wanted = self.ask(GetState, f"{node}/get_state").current_state.label, _STATES.index(goal)
        if state not in _STATES:
            raise CommissioningError(f"node '{node}' is in state '{state}'; allowed: {', '.join(_STATES)}")
        here = _STATES.index(state)
        while here != wanted:
            transition, there = (_UP[here], here + 1) if here < wanted else (_DOWN[here], here - 1)
            if not self.ask(ChangeState, f"{node}/change_state", transition=Transition(id=transition)).success:
                raise CommissioningError(f"node '{node}' did not become {_STATES[there]}; its log says why")
            here = there

    def give(self, node: str, values: Mapping[str, Any]) -> None:
        """Set parameters of ``node``, all or none."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        result = self.ask(SetParametersAtomically, f"{node}/set_parameters_atomically", parameters=parameters).result
        if not result.successful:
            raise CommissioningError(f"node '{node}': {result.reason}")

    def ask(self, kind: Any, service: str, **request: Any) -> Any:
        """The response of a service of this ``kind`` to a request with these fields."""
        client = self.service(kind, service)
        self.wait(lambda: client.ready, _START_S, f"service '{service}' is not there; does the node run?")
        future = client.call(kind.Request(**request))
        self.wait(future.done, ANSWER_S, f"service '{service}' does not answer")
        return future.result()

    def require(self, kind: Any, service: str, **request: Any) -> None:
        """Call a service that answers with success and message; CommissioningError with its message if it refuses."""
        response = self.ask(kind, service, **request)
        if not response.success:
            raise CommissioningError(f"{service}: {response.message or 'refused'}")

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()
