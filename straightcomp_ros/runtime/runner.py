"""Runs a node until it is stopped: executor, scheduling, signals, exit code. All nodes share it.

The EventsExecutor costs half the CPU of the SingleThreadedExecutor. In the PyPI wheels of Jazzy its bare
``spin()`` never fires a timer; ``spin_until_future_complete`` works there and with an installed Jazzy.
"""

import gc
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack

import rclpy
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from straightcomp_ros.cell.stop_signals import terminating
from straightcomp_ros.runtime.guarded_node import REFUSALS, RUN_FAILURES, GuardedNode
from straightcomp_ros.runtime.intra_process import IntraProcess
from straightcomp_ros.runtime.loops import IDLE_EVERY_NS, Loop
from straightcomp_ros.runtime.managed import EXIT_FAILURE, MakeComponent, ManagedNode
from straightcomp_ros.runtime.middleware import middleware_in_words, own_profile
from straightcomp_ros.timing import realtime
from straightcomp_ros.timing.cpus import end_loop, give_up_priority
from straightcomp_ros.timing.realtime import RealtimeParameters

EXIT_CONFIGURATION = 2
"""A parameter or a file cannot be used; nothing was started."""
# A longer wait overflows in the executor and ends at once.
_LONGEST_WAIT_S = 1e6
_SIGNALS_WITHIN_S, _COLLECT_S = 0.2, 1.0
_TIMERS_IN_A_ROW = 3
"""Of idle work, before a callback of the executor: three nodes in a process have 250 calls of timers a second, of 500
turns."""
_LEAVE_WITHIN_S = 2.0
"""Longest wait for the driver's answer at the end: a launcher kills a node 5 s after it asked it to end."""


class Runnable:
    """What the runner needs: a node to spin, a future that ends it, its scheduling, and a safe close."""

    node: GuardedNode
    done: Future  # its result is the process's exit code
    realtime: RealtimeParameters
    loop: Loop | None = None  # runs instead of the executor, which gets the idle time

    @property
    def turn(self) -> Future:
        """Done when another loop is to run, or none."""
        return self.done

    def fail(self, error: Exception) -> None:
        """Handle one of :data:`RUN_FAILURES` of the loop or a callback; by default it ends the process."""
        raise error

    def leave(self) -> Future | None:
        """Begin to switch the amplifier off if the work is not finished, also after an error of this node. None if
        there is nothing to switch off; otherwise a future whose result is why that failed, empty if it did not."""

    def close(self) -> None:
        """Leave outputs safe and data saved; by default nothing to do. The ROS context may have ended already."""


def run(
    name: str,
    make: Callable[..., Runnable],
    arguments: Sequence[str] | None = None,
    make_nodes: Callable[[], Sequence[GuardedNode]] | None = None,
) -> int:
    """Run what ``make`` makes of the node ``name`` until a stop signal, shutdown of the context or its own end.

    Returns:
        Exit code: 0 after a requested stop that interrupted no work, 2 if parameters or files cannot be used, 1 if the
        node failed or its work was interrupted, or the result that the node itself gave to ``done``.
    """
    # rclpy's own handlers shut the context down during a callback; ours let the callback end first.
    stop = Future()
    for number in (signal.SIGINT, *terminating()):
        signal.signal(number, lambda *_: _complete(stop, 0))
    try:
        with own_profile():
            words = None if arguments is None else list(arguments)
            rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
            nodes = (
                make_nodes()
                if make_nodes
                else (GuardedNode(name, automatically_declare_parameters_from_overrides=True),)
            )
            # Python handles signals only between its own instructions, and an idle executor runs none.
            nodes[0].create_timer(_SIGNALS_WITHIN_S, lambda: None)
            # Cyclic garbage is collected while there is little, so that it never is during a cycle.
            nodes[0].create_timer(_COLLECT_S, lambda: gc.collect(1))
    except Exception as error:
        # rclpy has an exception type for each kind of bad argument; the user needs only the message.
        print(f"{name}: {error}", file=sys.stderr)
        return EXIT_CONFIGURATION
    try:
        try:
            runnable = make(*nodes)
        except REFUSALS as error:
            print(f"{name}: {error}", file=sys.stderr)
            return EXIT_CONFIGURATION
        try:
            stop.add_done_callback(lambda _: _complete(runnable.done, 0))
            return _spin(runnable, nodes)
        finally:
            if runnable.realtime.cpus == realtime.LOOP:
                end_loop()
            runnable.close()
            give_up_priority()
    except RUN_FAILURES as error:
        print(f"{name}: {error}", file=sys.stderr)
        return EXIT_FAILURE
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()


class Composition(Runnable):
    """Managed nodes in one process: they end together, and the first one's scheduling is the process's, and so is its
    loop while it is active. One of :data:`REFUSALS` if a node cannot begin."""

    node: ManagedNode

    def __init__(self, *nodes: ManagedNode) -> None:
        self.nodes, self.node, self.done = nodes, nodes[0], Future()
        for node in nodes[1:]:
            node.share_timers(self.node)
        for node in nodes:
            node.loop_of_process = lambda: self.loop
            node.done.add_done_callback(lambda ended: _complete(self.done, ended.result()))
        for number, node in enumerate(nodes):
            try:
                node.begin()
            except Exception:
                for begun in nodes[:number]:
                    begun.close()
                raise
        self.realtime = self.node.realtime

    @property
    def loop(self) -> Loop | None:
        return self.node.loop

    @property
    def turn(self) -> Future:
        """Done when a node's state has changed, or all end."""
        turn = Future()
        for changed in (self.done, *(node.turn for node in self.nodes)):
            changed.add_done_callback(lambda _: _complete(turn, 0))
        return turn

    def fail(self, error: Exception) -> None:
        self.node.fail(error)

    def close(self) -> None:
        """Stop and release all components, the first one, the driver's, first: it switches the amplifier off. What one
        raises does not keep the others from saving what they have."""
        with ExitStack() as closing:
            for node in reversed(self.nodes):
                closing.callback(node.close)


Managed = tuple[str, type, MakeComponent]
"""A lifecycle node: name, parameter set and component."""


def run_managed(
    parts: Sequence[Managed],
    shared: IntraProcess | None = None,
    name: str = "",
    arguments: Sequence[str] | None = None,
) -> int:
    """Like :func:`run`, for lifecycle nodes, whose configuration makes their components; see :mod:`~.managed`.

    They are in one process, called ``name`` or like the first one, with the loop of the first one. Streams of
    ``shared`` are handed over in memory.
    """
    return run(name or parts[0][0], Composition, arguments, lambda: [ManagedNode(*part, shared) for part in parts])


def _complete(future: Future, result: int) -> None:
    if not future.done():
        future.set_result(result)


def _spin(runnable: Runnable, nodes: Sequence[GuardedNode]) -> int:
    executor = EventsExecutor()
    idle = _settle(runnable, nodes, executor)
    # Each node has as much idle work as in a process of its own.
    idle_every_ns = IDLE_EVERY_NS // len(nodes)
    try:
        while not runnable.done.done():
            turn = runnable.turn
            nodes[0].steady_timers.by_loop = bool(runnable.loop)
            try:
                if runnable.loop:
                    runnable.loop.run(turn.done, idle, idle_every_ns)
                else:
                    executor.spin_until_future_complete(turn, timeout_sec=_LONGEST_WAIT_S)
            except ExternalShutdownException:
                _complete(runnable.done, 0)
            except RUN_FAILURES as error:
                runnable.fail(error)
    finally:
        _complete(runnable.done, EXIT_FAILURE)
        interrupted = _left(runnable, executor)
    return int(runnable.done.result()) or (EXIT_FAILURE if interrupted else 0)


def _left(runnable: Runnable, executor: Executor) -> bool:
    """Let a client leave the machine with the amplifier off; returns whether that interrupted its work."""
    leaving, logger = runnable.leave(), runnable.node.get_logger()
    if leaving is None:
        return False
    refusal, end = f"the driver did not answer within {_LEAVE_WITHIN_S:g} s", time.monotonic() + _LEAVE_WITHIN_S
    try:
        # After an error in a callback the first call returns at once.
        while not leaving.done() and time.monotonic() < end:
            executor.spin_until_future_complete(leaving, timeout_sec=_LEAVE_WITHIN_S)
    except Exception as error:  # Another error ends this node already: say what became of the amplifier.
        refusal = str(error)
    if leaving.done():
        refusal = leaving.result()
    if refusal:
        logger.error(f"interrupted; the amplifier could not be switched off: {refusal}")
    else:
        logger.warning("interrupted; the amplifier has been switched off")
    return True


def _settle(runnable: Runnable, nodes: Sequence[GuardedNode], executor: Executor) -> Callable[[], None]:
    """Do everything that is done once before the first cycle; returns the idle work for a loop."""
    for node in nodes:
        executor.add_node(node)
    gc.collect()
    gc.freeze()
    gc.disable()
    logger = nodes[0].get_logger()
    graph = f"{nodes[0].context.get_domain_id()}{nodes[0].get_namespace()}"
    for refusal in realtime.apply(runnable.realtime, logger.info, graph, loop_alone=len(nodes) > 1):
        logger.warning(refusal)
    logger.info(middleware_in_words())
    logger.info("ready")

    return idle_turns(nodes[0].steady_timers.call_one, lambda: executor.spin_once(timeout_sec=0))


def idle_turns(call_one_timer: Callable[[], bool], spin_once: Callable[[], None]) -> Callable[[], None]:
    """A turn of idle work: one callback at most, so that the next cycle is not late; a timer that is due, or one of the
    executor's. After three timers it is the executor's turn: on a computer so busy that timers are always due, requests
    to switch off must still be answered."""
    timers_called = 0

    def idle() -> None:
        nonlocal timers_called
        if timers_called < _TIMERS_IN_A_ROW and call_one_timer():
            timers_called += 1
        else:
            timers_called = 0
            spin_once()

    return idle
