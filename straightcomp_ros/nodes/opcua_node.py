"""opcua: an OPC UA server through which a PLC runs the cell. Needs the extra `opcua`."""

from __future__ import annotations

import math
import time
from functools import partial
from typing import TYPE_CHECKING

from rclpy.task import Future

from straightcomp_ros.cell.cell_sequence import CellSequence
from straightcomp_ros.cell.packml import Order
from straightcomp_ros.opcua.address_space import Alarms, Snapshot
from straightcomp_ros.opcua.admission import AdmissionError
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import OpcuaNodeParameters
from straightcomp_ros.runtime.graph_client import GraphClient, RemoteParameters
from straightcomp_ros.runtime.guarded_node import GuardedNode
from straightcomp_ros.runtime.node_diagnostics import Diagnostics
from straightcomp_ros.runtime.ros_parameters import declare
from straightcomp_ros.runtime.runner import EXIT_FAILURE, Runnable, run
from straightcomp_ros.stage.due_maintenance import due_maintenance

if TYPE_CHECKING:
    # It needs asyncua, an optional dependency.
    from straightcomp_ros.opcua.gateway_server import GatewayServer, Request

_TICK_S, _ADVICE_S = 0.02, 1.0


class OpcuaNode(Runnable):
    """Connects the ROS graph, the PackML state machine and the OPC UA server."""

    def __init__(self, node: GuardedNode) -> None:
        self._parameters = parameters = declare(node, OpcuaNodeParameters)
        self.node, self.done, self.realtime = node, Future(), parameters.realtime
        names = parameters.nodes.split()
        self._graph = GraphClient(node, names, stage=parameters.stage)
        self._remote = RemoteParameters(node, ["driver"])
        count = parameters.stage.encoder.x_resolution
        self._sequence = CellSequence(self._graph, parameters.stage.motion, parameters.start_timeout, count=count)
        self._alarms = Alarms(parameters.error_limit)
        self._due = ""
        self._commands = 0
        self._answers: list[tuple[Request, str]] = []
        self._logged = ""
        self._server = _server(parameters, names)
        Diagnostics(node, lambda: {"samples": self._commands, "state": self._sequence.state.name.lower()})
        node.create_timer(_TICK_S, self._tick)
        node.create_timer(_ADVICE_S, self._read_advice)
        security = "encrypted" if parameters.opcua.encrypted else "not encrypted"
        node.get_logger().info(f"OPC UA at {parameters.opcua.endpoint}, {security}")

    def _read_advice(self) -> None:
        self._due = due_maintenance(self._parameters.maintenance_file)

    def _tick(self) -> None:
        if self.done.done():
            return
        self._graph.fetch()
        seen = self._graph.observation()
        for request in self._server.requests():
            self._commands += 1
            self._obey(request)
        sequence = self._sequence
        sequence.tick(seen)
        # Where it starts, a state has no message.
        state = ": ".join(filter(None, (sequence.state.name.lower(), sequence.message)))
        if state != self._logged:
            self._logged = state
            self.node.get_logger().info(state)
        alarms = self._alarms.active(seen, sequence.state, time.monotonic(), self._due)
        moves = sequence.movements
        strokes = moves.strokes, moves.strokes_done
        shown = Snapshot(sequence.state, sequence.message, *strokes, sequence.centred, seen, alarms, self._limits())
        self._server.show(shown)
        # Answer last: a client that reads the state after its call must see the call's effect.
        answers, self._answers = self._answers, []
        for request, refusal in answers:
            request.answer.set_result(refusal)
        if not self._server.alive:
            self.node.get_logger().error("the OPC UA server has ended")
            self.done.set_result(EXIT_FAILURE)

    def _obey(self, request: Request) -> None:
        def answered(refusal: str) -> None:
            self._answers.append((request, refusal))

        if isinstance(request.asked, Order):
            # The node that is asked gives the answer later.
            self._sequence.order(request.asked, int(request.argument), answered)
        else:
            answered(self._sequence.command(request.asked, request.argument))

    def _limits(self) -> dict[str, float]:
        driver, motion = self._remote.values.get("driver", {}), self._parameters.stage.motion
        backend = "can" if driver.get("hardware") == "can" else "simulated"
        return {
            "ControlCurrent": driver.get("stage.actuator.current_limit", math.nan),
            "CommandTimeout": driver.get(f"{backend}.command_timeout", math.nan),
            "ErrorPeakToPeak": self._parameters.error_limit,
            "StrokeStart": motion.start,
            **{name.capitalize(): getattr(motion, name) for name in ("stroke", "speed", "acceleration")},
        }

    def leave(self) -> Future | None:
        """Switch the amplifier off if a cycle runs, since no client can hold or stop it any more."""
        return self._graph.leave() if self._sequence.at_work else None

    def close(self) -> None:
        """Stop the server."""
        self._server.close()


def _server(parameters: OpcuaNodeParameters, names: list[str]) -> GatewayServer:
    try:
        from straightcomp_ros.opcua.gateway_server import GatewayServer
    except ImportError as error:
        raise ParameterError(f"{error.name} is not installed; remedy: pip install 'straightcomp_ros[opcua]'") from error
    try:
        return GatewayServer(parameters.opcua, names)
    except AdmissionError as error:
        raise ParameterError(f"parameter group 'opcua': {error}") from error


main = partial(run, "opcua", OpcuaNode)
"""Entry point of `ros2 run straightcomp_ros opcua_node`."""
