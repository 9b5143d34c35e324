"""cell: a reference client of the ROS graph, in the role of a cell controller.

It activates the nodes, switches the amplifier on, homes, runs the strokes, reacts to faults, and reports.
"""

import time
from collections.abc import Iterator
from functools import partial

from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from straightcomp_ros.cell.cell_sequence import AMPLIFIER_OFF, CellSequence, check_strokes
from straightcomp_ros.cell.launcher import IN_THE_LOOP
from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import Command, State, name
from straightcomp_ros.model.motion import forward_and_back
from straightcomp_ros.parameters.node_parameters import CellNodeParameters
from straightcomp_ros.runtime.graph_client import GraphClient
from straightcomp_ros.runtime.guarded_node import GuardedNode, Refused
from straightcomp_ros.runtime.ros_parameters import declare
from straightcomp_ros.runtime.runner import EXIT_FAILURE, Runnable, run
from straightcomp_ros.timing.node_timing import LOST, blamed, held_up

_TICK_S = 0.05
_REPORTED_S = 1.5
"""Every node publishes its next diagnostics within this time."""
_SAID_EVERY_S = 5.0
"""What a cycle waits for is said again after this time."""
_GIVEN_UP = (State.STOPPING, State.STOPPED, State.ABORTING, State.ABORTED)
_QUIET_S = 0.5
"""A node without a heartbeat for this time, of ten in a second, may have ended."""


class CycleFailed(Exception):
    """The cycle cannot go on; the message says why."""


class CellNode(Runnable):
    """Lets the sequencer run one cycle; in :meth:`_cycle` each ``yield`` waits for the next tick."""

    def __init__(self, node: GuardedNode) -> None:
        self._parameters = parameters = declare(node, CellNodeParameters)
        check_strokes(parameters.stage.motion, parameters.strokes)
        self.node, self.done, self.realtime = node, Future(), parameters.realtime
        self._graph = GraphClient(
            node,
            parameters.nodes.split(),
            batches=(),
            fresh=parameters.sample_timeout,
            patient=True,
            stage=parameters.stage,
            silent_after=parameters.heartbeat_timeout,
        )
        self._seen = Observation()
        self._sequence = CellSequence(
            self._graph,
            parameters.stage.motion,
            parameters.start_timeout,
            as_one=True,
            count=parameters.stage.encoder.x_resolution,
            home=parameters.home,
            recoveries=parameters.recoveries,
        )
        node.offer(SetBool, "~/hold", self._on_hold)
        node.offer(Trigger, "~/stop", self._on_stop)
        self._failing = False
        self._steps = self._explained(self._cycle())
        node.create_timer(_TICK_S, self._tick)

    def _on_hold(self, on: bool) -> str:
        """Bring the stage to rest where it is, with the amplifier on, or let its cycle go on."""
        return self._obey(Command.HOLD if on else Command.UNHOLD)

    def _on_stop(self) -> str:
        """Bring the stage to rest where it is, and end the cycle there, with the amplifier off."""
        return self._obey(Command.STOP)

    def _obey(self, command: Command) -> str:
        if reason := self._sequence.command(command):
            raise Refused(reason)
        return f"command {name(command)}"

    def _explained(self, cycle: Iterator[None]) -> Iterator[None]:
        """Run the cycle. If it fails, add to the message which node does not work any more, or what delayed them."""
        try:
            yield from cycle
        except CycleFailed as failure:
            self._failing = True
            before, end = self._graph.reports(), time.monotonic() + _REPORTED_S
            # Keep ticking: the sequencer still has to switch the amplifier off, in Stopping once the stage stands.
            while (
                time.monotonic() < end
                or self._sequence.state is State.STOPPING
                or (not self._seen.missing and self._graph.quiet(_QUIET_S))
            ):
                yield
            if self._seen.missing:
                gone = self._seen.absence
                raise CycleFailed(str(failure) if gone in str(failure) else f"{failure} ({gone})") from failure
            after = self._graph.reports()
            why = blamed({node: held_up([before.get(node, {}), after[node]]) for node in IN_THE_LOOP if node in after})
            raise CycleFailed(f"{failure} ({why})" if why else str(failure)) from failure

    def _cycle(self) -> Iterator[None]:
        log, sequence, strokes = self.node.get_logger(), self._sequence, self._parameters.strokes
        sequence.command(Command.RESET)
        yield from self._until(State.IDLE)
        sequence.command(Command.START, strokes)
        yield from self._until(State.EXECUTE)
        self._graph.expect_samples()
        log.info(f"stage moves: {forward_and_back(self._parameters.stage.motion)[-1].time_ns * strokes * 1e-9:.1f} s")
        yield from self._follow_motion()
        yield from self._until(State.COMPLETE)
        self._show_progress(1.0)
        yield from self._all_alive()
        lost = self._graph.reports().get("driver", {}).get(LOST, "?")
        log.info(f"cycle complete: strokes {strokes}, faults {sequence.recovered}, samples lost {lost}")

    def _all_alive(self) -> Iterator[None]:
        """Wait for a heartbeat of each node: one that died in the last moments is not seen to be missing yet."""
        begin = time.monotonic()
        while self._graph.quiet(time.monotonic() - begin):
            if self._seen.missing:
                raise CycleFailed(self._seen.absence)
            yield

    def _follow_motion(self) -> Iterator[None]:
        sequence, recovered = self._sequence, 0
        while sequence.state in (State.EXECUTE, State.HOLDING, State.HELD, State.UNHOLDING):
            self._show_progress(sequence.progress)
            if sequence.recovered > recovered:
                recovered = sequence.recovered
                self.node.get_logger().warning(f"fault {recovered}: {self._reason}; switching on again")
            yield
        if sequence.state in _GIVEN_UP:
            off = sequence.message == (self._seen.fault if "driver" in self._seen.faults else AMPLIFIER_OFF)
            raise CycleFailed(f"amplifier off in mid-cycle: {self._reason}" if off else sequence.message)

    def _show_progress(self, fraction: float) -> None:
        if self._parameters.progress:
            print(f"progress {min(fraction, 1.0):.3f}", flush=True)

    @property
    def _reason(self) -> str:
        return self._seen.faults.get("driver", "another client switched it off")

    def _until(self, state: State) -> Iterator[None]:
        said = time.monotonic()
        while self._sequence.state is not state:
            if self._sequence.state in _GIVEN_UP:
                raise CycleFailed(self._sequence.message)
            if self._sequence.message and time.monotonic() - said > _SAID_EVERY_S:
                said = time.monotonic()
                self.node.get_logger().info(self._sequence.message)
            yield

    def _tick(self) -> None:
        if self.done.done():
            return
        self._graph.fetch()
        self._seen = self._graph.observation()
        self._sequence.tick(self._seen)
        try:
            next(self._steps)
        except StopIteration:
            self.done.set_result(0)
        except CycleFailed as failure:
            self.node.get_logger().error(f"cycle failed: {failure}")
            self.done.set_result(EXIT_FAILURE)

    def leave(self) -> Future | None:
        """Switch the amplifier off if the cycle is not finished."""
        if self._sequence.at_work:
            return self._graph.leave()
        if not self._failing or self.done.result() != 0:
            return None
        # Stopped while it waits for the reason of its failure: the amplifier is off.
        left = Future()
        left.set_result("")
        return left


main = partial(run, "cell", CellNode)
"""Entry point of `ros2 run straightcomp_ros cell_node`."""
