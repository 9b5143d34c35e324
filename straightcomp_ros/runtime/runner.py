"""Runs a node until it is told to stop: executor, scheduling, signals, exit code. All nodes share it.

The EventsExecutor costs half the CPU of the SingleThreadedExecutor. In the PyPI wheels of Jazzy its bare
``spin()`` never fires a timer; ``spin_until_future_complete`` works there and with an installed Jazzy.
"""

import gc
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import rclpy
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from straightcomp_ros.runtime.managed import EXIT_FAILURE, REFUSALS, RUN_FAILURES, MakeComponent, ManagedNode
from straightcomp_ros.runtime.middleware import middleware_in_words, own_profile
from straightcomp_ros.runtime.periodic import Loop
from straightcomp_ros.runtime.timers import WithSteadyTimers
from straightcomp_ros.timing import realtime
from straightcomp_ros.timing.realtime import RealtimeParameters

EXIT_CONFIGURATION = 2
"""A parameter or a file is wrong; nothing was started."""
# Longer values overflow in the executor and end the wait at once.
_LONGEST_WAIT_S = 1e6
_LONGEST_DEAFNESS_S = 0.2


class Runnable(Protocol):
    """What the runner needs: a node to spin, whether and how it is done, and a way to leave the outputs safe."""

    node: WithSteadyTimers
    done: Future  # its result is the process's exit code
    realtime: RealtimeParameters
    loop: Loop | None  # runs in the place of the executor, which then gets the idle time

    def close(self) -> None:
        """Leave everything safe and saved; here nothing. The ROS context may be gone already."""


def run(name: str, make: Callable[[Node], Runnable], arguments: Sequence[str] | None = None) -> int:
    """Make the node ``name``, run it until SIGINT, SIGTERM, shutdown of the context or its own end.

    Returns:
        Exit code: 0 after a stop that was asked for, 2 when parameters or files are wrong, 1 when the node
        failed, or what the node itself gave as the result of ``done``.
    """
    return _run(
        name, lambda: WithSteadyTimers(name, automatically_declare_parameters_from_overrides=True), make, arguments
    )


def run_managed(name: str, parameter_set: type, make: MakeComponent, arguments: Sequence[str] | None = None) -> int:
    """The same for a lifecycle node, whose work is made by its configuration; see :mod:`~.managed`."""

    def begun(node: ManagedNode) -> ManagedNode:
        node.begin()
        return node

    return _run(name, lambda: ManagedNode(name, parameter_set, make), begun, arguments)


def _run(
    name: str, make_node: Callable[[], Any], make: Callable[[Any], Runnable], arguments: Sequence[str] | None
) -> int:
    # rclpy's own handlers shut the context down under a running callback; ours let it end first.
    stop = _StopRequest()
    try:
        with own_profile():
            rclpy.init(
                args=None if arguments is None else list(arguments), signal_handler_options=SignalHandlerOptions.NO
            )
            node = make_node()
            # Python sees a signal only between two steps of its own; an idle executor takes none. Cyclic garbage is
            # collected here, where it is little yet, and never in the middle of a cycle.
            node.create_timer(_LONGEST_DEAFNESS_S, lambda: gc.collect(1))
    except Exception as error:
        # rclpy has one exception type for each kind of bad argument; all mean the same to the user.
        print(f"{name}: {error}", file=sys.stderr)
        return EXIT_CONFIGURATION
    try:
        try:
            runnable = make(node)
        except REFUSALS as error:
            print(f"{name}: {error}", file=sys.stderr)
            return EXIT_CONFIGURATION
        try:
            stop.ends(runnable.done)
            code = _spin(runnable)
        finally:
            runnable.close()
        return code
    except RUN_FAILURES as error:
        print(f"{name}: {error}", file=sys.stderr)
        return EXIT_FAILURE
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


class _StopRequest:
    """SIGINT and SIGTERM from now on: they end a node's future, as soon as there is one."""

    def __init__(self) -> None:
        self._requested = False
        self._done: Future | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)

    def ends(self, done: Future) -> None:
        """A request completes ``done`` with exit code 0; one that came before does so now."""
        self._done = done
        if self._requested:
            self._request()

    def _request(self, *_: object) -> None:
        self._requested = True
        if self._done is not None and not self._done.done():
            self._done.set_result(0)


def _spin(runnable: Runnable) -> int:
    executor = EventsExecutor()
    idle = _settle(runnable, executor)
    managed = runnable if isinstance(runnable, ManagedNode) else None
    while not runnable.done.done():
        # Another state of a managed node has another loop, or none.
        turn = managed.turn if managed else runnable.done
        try:
            if runnable.loop:
                runnable.loop.run(turn.done, idle)
            else:
                executor.spin_until_future_complete(turn, timeout_sec=_LONGEST_WAIT_S)
        except ExternalShutdownException:
            return 0
        except RUN_FAILURES as error:
            if managed is None:
                raise
            managed.fail(error)
    return int(runnable.done.result())


def _settle(runnable: Runnable, executor: Executor) -> Callable[[], None]:
    """All that is done once before the first cycle; returns what a loop is to do in its idle time."""
    executor.add_node(runnable.node)
    logger = runnable.node.get_logger()
    for refusal in realtime.apply(runnable.realtime, logger.info):
        logger.warning(refusal)
    logger.info(middleware_in_words())
    logger.info("ready")
    gc.collect()
    gc.freeze()
    gc.disable()

    def idle() -> None:
        # One callback at most: never enough of them to make the next cycle late.
        if not call_one_timer():
            executor.spin_once(timeout_sec=0)

    call_one_timer = runnable.node.steady_timers.call_one
    return idle
