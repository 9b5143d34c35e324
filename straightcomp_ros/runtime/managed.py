"""A lifecycle node (ROS 2 managed node) around one component that does the work.

    unconfigured ──configure──▶ inactive ──activate──▶ active
                 ◀──cleanup────          ◀─deactivate─

*Configure* reads the parameters and makes the component: files, hardware, topics, services. *Activate* starts it,
*deactivate* stops it with safe outputs, *cleanup* and *shutdown* release all that it has made. A component that fails
is released too, and the node becomes unconfigured. With the parameter ``autostart`` the node activates itself, and its
process ends when the component fails, like the process of a plain node.

What takes longer than a cycle is done at normal priority: another graph's loop may run on the same CPU.
"""

import gc
import time
import traceback
from collections.abc import Callable
from typing import Any, Protocol

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.serialization import serialize_message
from rclpy.task import Future

from straightcomp_ros.contract import HEARTBEAT
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.runtime.guarded_node import REFUSALS, GuardedNode, ThrottledWarning, refusal
from straightcomp_ros.runtime.inside_rclpy import lifecycle_state, state_service, withdraw
from straightcomp_ros.runtime.intra_process import IntraProcess
from straightcomp_ros.runtime.loops import Loop
from straightcomp_ros.runtime.ros_parameters import ParameterChanges, declare
from straightcomp_ros.runtime.streams import Streams
from straightcomp_ros.timing.cpus import at_normal_priority

EXIT_FAILURE = 1
"""Exit code of a node that failed while it ran."""
_HEARTBEAT_S = 0.1
_ENTITIES = ("client", "subscription", "publisher")
"""What a component makes on its node, besides what it offers."""
_PAUSE_S = 0.001
_WITHDRAWN_S = 0.1
"""Time in which the executor drops what was withdrawn from it."""


class Component(Protocol):
    """The work of a managed node. *Configure* makes it; it is then at rest."""

    loop: Loop | None
    """Runs instead of the executor while the node is active; the executor gets its idle time."""

    def activate(self) -> None:
        """Start."""

    def deactivate(self) -> None:
        """Stop, with safe outputs."""

    def prepare(self, parameters: Any) -> Callable[[], None]:
        """Prepare other values of the dynamic parameters; the returned function applies them. One of :data:`REFUSALS`
        if they cannot be applied; nothing has changed then."""

    def close(self) -> None:
        """Release everything, saved and safe. The ROS context may have ended already."""


MakeComponent = Callable[["ManagedNode", Any], Component]


class ManagedNode(GuardedNode, LifecycleNode):
    """Handles the transitions; the component does their work.

    ``parameter_set`` has a field ``autostart`` and one ``realtime``; ``make(node, parameters)`` makes the component.
    ``shared`` is as of :class:`~.streams.Streams`.

    Attributes:
        active: whether the state is active.
        done: its result is the process's exit code.
        turn: done when the state has changed, so that the runner runs another loop, or none.
        streams: the component's ends of the graph's streams.
        loop_of_process: the loop that runs now in this process, if any: with several nodes, that of one of them.
    """

    def __init__(self, name: str, parameter_set: type, make: MakeComponent, shared: IntraProcess | None = None) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self.done, self.turn = Future(), Future()
        self.streams = Streams(self, shared)
        self.loop_of_process: Callable[[], Loop | None] = lambda: self.loop
        self._parameter_set, self._make = parameter_set, make
        self._component: Component | None = None
        self.active = False
        self._failure: Exception | None = None
        self._own: set[int] = set()
        self._own_timers = 0
        self._beats: dict[str, bytes] = {}
        self.done.add_done_callback(lambda _: self._turn())
        _refuse_wrong_transitions(self)

    def begin(self) -> None:
        """Declare the parameters; with ``autostart`` configure and activate. One of :data:`REFUSALS` if that fails."""
        parameters = declare(self, self._parameter_set, changeable=True)
        self.realtime = parameters.realtime
        self._autostart = parameters.autostart
        self._changes = ParameterChanges(self, self._parameter_set)
        self._send_beat = self.streams.sending(self.create_publisher(DiagnosticStatus, HEARTBEAT, 10))
        self.create_timer(_HEARTBEAT_S, self._beat)
        if self._autostart:
            self.trigger_configure()
            if self._component is not None:
                self.trigger_activate()
            if self._failure is not None:
                raise self._failure

    @property
    def loop(self) -> Loop | None:
        """The loop to run now instead of the executor, if any."""
        return self._component.loop if self._component is not None and self.active else None

    def go_on(self) -> None:
        """What a callback calls while it waits for a job in another thread: one cycle of the loop, or a pause, and a
        timer that is due. A node whose heartbeats cease counts as dead."""
        loop = self.loop_of_process()
        if loop is not None:
            loop.turn()
        else:
            time.sleep(_PAUSE_S)
        self.steady_timers.call_one()

    def fail(self, error: Exception) -> None:
        """Report a failure of the component: with ``autostart`` end the process, otherwise become unconfigured."""
        if self._failure is not None:
            return
        self._failure = error
        self.get_logger().error(str(error))
        if self._autostart:
            self.done.set_result(EXIT_FAILURE)
        elif self.active:
            self.trigger_deactivate()

    def close(self) -> None:
        """Stop and release the component, if there is one."""
        if self.active and self._component is not None:
            self.active = False
            self._component.deactivate()
        self._release()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._failure = None
        # Remember the node's own entities: they stay when the component is released.
        self._own = {id(entity) for kind in _ENTITIES for entity in getattr(self, f"{kind}s")}
        self._own_timers = len(self.own_timers)

        def configure() -> None:
            self._component = component = self._make(self, self._changes.parameters())
            self._changes.prepare = component.prepare

        with at_normal_priority():
            if gc.get_freeze_count():
                # A former component, which activation has excluded from garbage collection. A process that ends need
                # not collect it.
                gc.unfreeze()
                gc.collect()
            code = self._attempt(configure, TransitionCallbackReturn.FAILURE)
        if self._component is None:
            self._destroy_entities()
        return code

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._failure = None
        assert self._component is not None
        code = self._attempt(self._component.activate)
        self.active = code is TransitionCallbackReturn.SUCCESS
        with at_normal_priority():
            # Objects made since the start are long-lived too: exclude them from garbage collection.
            gc.collect()
            gc.freeze()
        self._turn()
        return code

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = False
        self._turn()
        assert self._component is not None
        code = self._attempt(self._component.deactivate)
        return TransitionCallbackReturn.ERROR if self._failure is not None else code

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._attempt(self._release)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._turn()
        return self._attempt(self.close)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._turn()
        self._attempt(self.close)
        # Whatever failed, the component has been released: the node can be configured again.
        return TransitionCallbackReturn.SUCCESS

    def _attempt(
        self, work: Callable[[], None], otherwise: TransitionCallbackReturn = TransitionCallbackReturn.ERROR
    ) -> TransitionCallbackReturn:
        """Do ``work`` and log its exception, which rclpy would swallow silently."""
        try:
            work()
        except Exception as error:
            if isinstance(error, REFUSALS):
                self._failure = error
            else:
                self._failure = ParameterError(f"{type(error).__name__}: {error}")
                self.get_logger().debug(traceback.format_exc())
            self.get_logger().error(str(self._failure))
            return otherwise
        return TransitionCallbackReturn.SUCCESS

    def _release(self) -> None:
        component, self._component = self._component, None
        self.active = False
        self._changes.prepare = None
        with at_normal_priority():
            try:
                if component is not None:
                    component.close()
            finally:
                self._destroy_entities()

    def _destroy_entities(self) -> None:
        self.streams.close()
        self.refuse_all(f"the node '{self.get_name()}' is not configured")
        self.cancel_timers(self._own_timers)
        withdrawn = [
            withdraw(self, kind, entity)
            for kind in _ENTITIES
            for entity in list(getattr(self, f"{kind}s"))
            if id(entity) not in self._own
        ]

        def destroy() -> None:
            later.cancel()
            for entity in withdrawn:
                entity()

        later = self.steady_timers.add(_WITHDRAWN_S, destroy)

    def _beat(self) -> None:
        state = lifecycle_state(self)
        if state not in self._beats:
            # Serialise once: with cold caches that takes longer than publishing.
            beat = DiagnosticStatus(name=self.get_name(), message=state, hardware_id=self.get_fully_qualified_name())
            self._beats[state] = serialize_message(beat)
        self._send_beat(self._beats[state])

    def _turn(self) -> None:
        before, self.turn = self.turn, Future()
        if not before.done():
            before.set_result(None)


def _refuse_wrong_transitions(node: LifecycleNode) -> None:
    """Answer a transition that the state does not allow with ``success`` false; rclpy lets it end the process."""
    service = state_service(node)
    change, refused = service.callback, ThrottledWarning(node, "a transition is refused")

    def answer(request: Any, response: Any) -> Any:
        try:
            return change(request, response)
        except RuntimeError as error:
            return refusal(response, refused.log(str(error).partition("\n")[0]))

    service.callback = answer
