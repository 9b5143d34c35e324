"""The nodes that clients see, what the gateway shows in them at one moment with its alarms, and how it is written."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import Any

from asyncua import Server, ua
from asyncua.common.node import Node

from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import Command, Order, State, name
from straightcomp_ros.opcua import CELL, NAMESPACE

ALARMS: Mapping[str, tuple[int, str]] = {
    "Fault": (900, "a node reports a fault; the amplifier is off"),
    "NodeMissing": (700, "a node of the graph is not there or does not work"),
    "NoSamples": (700, "no samples come from the machine"),
    "ErrorLimit": (500, "error of the last stroke above opcua_node's parameter error_limit"),
    "SampleLoss": (300, "samples did not come to the controller during the last ten seconds"),
    "MaintenanceDue": (200, "advice from the stage's history, see opcua_node's parameter maintenance_file"),
}
"""By name: severity as OPC UA counts (1 to 1000), and what it means."""


@dataclass(frozen=True)
class Snapshot:
    """State, message, strokes and reference of the cell's sequence, and the observation of the graph."""

    state: State = State.STOPPED
    message: str = ""
    strokes: int = 0
    strokes_done: int = 0
    centred: bool = False
    seen: Observation = field(default_factory=Observation)
    alarms: Mapping[str, str] = field(default_factory=dict)  # text by name of those that are active
    limits: Mapping[str, float] = field(default_factory=dict)  # by name, SI units; NaN where not known yet


class Alarms:
    """Finds the active alarms, with a limit of a stroke's peak-to-peak error in m."""

    def __init__(self, error_limit: float) -> None:
        self._error_limit = error_limit
        self._lost: int | None = None
        self._loss, self._loss_until = "", -math.inf

    def active(self, seen: Observation, state: State, now: float, maintenance: str = "") -> dict[str, str]:
        """Text by name of each alarm active at the monotonic time ``now``; ``maintenance`` is what is due, in words."""
        found = {"Fault": seen.fault}
        # Nothing need run in a machine that is stopped.
        if state is not State.STOPPED:
            found["NodeMissing"] = ", ".join(seen.missing)
            found["NoSamples"] = "" if seen.fresh else "no samples come in"
        if seen.stroke_error_pp > self._error_limit:
            error_um, limit_um = seen.stroke_error_pp * 1e6, self._error_limit * 1e6
            found["ErrorLimit"] = f"{error_um:.3f} µm over the last stroke; limit {limit_um:g} µm"
        # Without samples the controller has not reported, and 0 lost says nothing.
        if seen.samples:
            before, self._lost = self._lost, seen.lost_samples
            if before is not None and seen.lost_samples > before:
                self._loss, self._loss_until = f"{seen.lost_samples - before} samples lost", now + 10.0
        found["MaintenanceDue"] = maintenance
        found["SampleLoss"] = self._loss if now < self._loss_until else ""
        return {name: text for name, text in found.items() if text}


T = ua.VariantType
Commander = Callable[[Command | Order, int], Awaitable[str]]
"""Takes a command and its argument, 0 without one; returns the reason of a refusal, or an empty text."""
# UNECE Recommendation 20, as OPC UA numbers it: three characters, base 256.
_UNITS = {"m": "MTR", "m/s": "MTS", "m/s²": "MSK", "A": "AMP", "s": "SEC"}


@dataclass(frozen=True)
class Value:
    """One variable: OPC UA type, what it means, unit, and where a snapshot has it."""

    kind: ua.VariantType
    description: str
    read: Callable[[Snapshot], Any]
    unit: str = ""
    live: bool = False
    """It is nothing to go by while no samples come."""


_STATUS = {
    "StateCurrent": Value(T.Int32, "State, PackML's number", lambda s: int(s.state)),
    "StateName": Value(T.String, "State, PackML's name", lambda s: name(s.state)),
    "Message": Value(T.String, "Why the state is what it is, or a command was refused", lambda s: s.message),
    "StrokesAsked": Value(T.UInt32, "Strokes forward and back of the last Start", lambda s: s.strokes),
    "StrokesDone": Value(T.UInt32, "Of these", lambda s: s.strokes_done),
    "Centred": Value(T.Boolean, "Reference in the middle of the travel, by Center", lambda s: s.centred),
    "Commissioning": Value(
        T.String, "What commissioning is doing; empty: no cycle is refused for it", lambda s: s.seen.commissioning
    ),
    "StageState": Value(
        T.String,
        "Motion of the stage: rest, moving (pauses too), stopping, held; empty while no driver reports it",
        lambda s: s.seen.stage.condition,
    ),
    "Override": Value(T.Double, "Speed of the stage's motions in % of theirs", lambda s: 100.0 * s.seen.stage.override),
    "FaultCode": Value(T.UInt32, "Number of the latched fault (docs/safety.md); 0: none", lambda s: s.seen.fault_code),
    "AmplifierOn": Value(T.Boolean, "Amplifier of the platform", lambda s: s.seen.amplifier_on),
}
_LIVE = {
    "X": Value(T.Double, "Position of the stage", lambda s: s.seen.x, "m", True),
    "Y": Value(T.Double, "Position of the platform", lambda s: s.seen.y, "m", True),
    "Error": Value(T.Double, "Compensation error r − y", lambda s: s.seen.error, "m", True),
    "SlidingVariable": Value(T.Double, "σ of the law", lambda s: s.seen.sliding_variable, "m/s", True),
    "ErrorPeakToPeak": Value(
        T.Double, "Error over the last movement of the stage", lambda s: s.seen.stroke_error_pp, "m"
    ),
    "Samples": Value(T.UInt64, "Samples since the controller's start", lambda s: s.seen.samples, live=True),
    "LostSamples": Value(T.UInt64, "That did not come to it", lambda s: s.seen.lost_samples, live=True),
}
LIMITS: Mapping[str, tuple[str, str]] = {
    "ControlCurrent": ("A", "Command beyond ± this: fault"),
    "CommandTimeout": ("s", "No command for so long: fault"),
    "ErrorPeakToPeak": ("m", "Error of a stroke above this: alarm"),
    "StrokeStart": ("m", "Where strokes begin"),
    "Stroke": ("m", "Length of a stroke"),
    "Speed": ("m/s", "Cruising speed of a stroke"),
    "Acceleration": ("m/s²", "Acceleration and deceleration of a stroke"),
}
"""By name: unit and meaning."""
_METHODS: Mapping[Command | Order, str] = {
    Command.RESET: "Bring all nodes up; to Idle",
    Command.START: "Amplifier on, so many strokes; 0: compensate until Complete, others move the stage",
    Command.STOP: "Bring the stage to rest within its limits and end there, amplifier off; to Stopped",
    Command.HOLD: "Bring the stage to rest within its limits, amplifier on; to Held",
    Command.UNHOLD: "Go on with the same movement",
    Command.ABORT: "Amplifier off at once; to Aborted",
    Command.CLEAR: "Reset faults; to Stopped",
    Command.COMPLETE: "End at the end of the present movement, amplifier off; to Complete",
    Order.RELOAD_MAP: "Read the map's file again; the reference goes over to it without a bump",
    Order.CENTER: "Reference to the middle of the travel, or back to the map, without a bump; Reset takes it back too",
    Order.OVERRIDE: "Speed of the stage, of the present movement too; it changes its speed within its limits",
    Order.JOG: "Move the stage from where it stands; in Execute with 0 strokes",
}
ARGUMENTS: Mapping[Command | Order, tuple[str, ua.VariantType, str]] = {
    Command.START: ("Strokes", T.UInt32, "Forward and back; 0: until Complete"),
    Order.CENTER: ("Middle", T.Boolean, "false: back to the map"),
    Order.OVERRIDE: ("Percent", T.UInt32, "0 to 100 % of the speed of its motions; 0: it stands"),
    Order.JOG: ("Micrometres", T.Int32, "Distance; negative: backward"),
}
"""Of the methods that take one: name, type and meaning."""


class AddressSpace:
    """All nodes below Objects/StraightnessCell; make it with :meth:`build`."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._index = self._heartbeat = 0
        self._values: list[tuple[Node, Value]] = []
        self._written: dict[Node, object] = {}
        self._active: Mapping[str, str] = {}

    async def build(self, nodes: Sequence[str], command: Commander) -> None:
        """Make all nodes; ``nodes`` are those of the graph whose state is shown, ``command`` is what methods do."""
        self._index = await self._server.register_namespace(NAMESPACE)
        cell = await self._add(self._server.nodes.objects.add_object, CELL)
        counter = Value(T.UInt32, "Counts up ten times a second", lambda _: self._heartbeat)
        folders = {
            "Status": {**_STATUS, "Heartbeat": counter},
            "Live": _LIVE,
            "Limits": {
                key: Value(T.Double, text, lambda s, key=key: s.limits.get(key, math.nan), unit)
                for key, (unit, text) in LIMITS.items()
            },
            "Nodes": {
                node: Value(T.String, "State", lambda s, node=node: s.seen.nodes.get(node, "absent")) for node in nodes
            },
            "Alarms": {
                key: Value(T.String, f"{text}; empty: not active", lambda s, key=key: s.alarms.get(key, ""))
                for key, (_, text) in ALARMS.items()
            },
        }
        for title, values in folders.items():
            folder = await self._add(cell.add_folder, f"{CELL}.{title}")
            for key, value in values.items():
                await self._add_variable(folder, f"{CELL}.{title}.{key}", value)
        commands = await self._add(cell.add_folder, f"{CELL}.Commands")
        for kind, text in _METHODS.items():
            await self._add_method(commands, kind, text, command)
        self._events = await self._server.get_event_generator(ua.ObjectIds.SystemEventType, cell)

    async def write(self, snapshot: Snapshot) -> None:
        """Write what has changed, and send an event for each alarm that came or went."""
        self._heartbeat = (self._heartbeat + 1) % 2**32
        now = datetime.now(timezone.utc)
        for node, value in self._values:
            number = value.read(snapshot)
            absent = isinstance(number, float) and not math.isfinite(number)
            status = ua.StatusCodes.Good
            if value.live and not snapshot.seen.fresh:
                status = ua.StatusCodes.BadNoCommunication
            elif absent:
                status = ua.StatusCodes.BadWaitingForInitialData
            if self._written.get(node) == (number, status):
                continue
            self._written[node] = (number, status)
            variant = ua.Variant(None if absent else number, T.Null if absent else value.kind)
            await self._server.write_attribute_value(
                node.nodeid, ua.DataValue(variant, ua.StatusCode(status), SourceTimestamp=now)
            )
        before, self._active = self._active, dict(snapshot.alarms)
        for alarm in ALARMS:
            if (alarm in before) != (alarm in self._active):
                self._events.event.Severity = ALARMS[alarm][0] if alarm in self._active else 1
                await self._events.trigger(message=f"{alarm}: {self._active.get(alarm, 'over')}")

    async def _add(self, make: Callable[..., Awaitable[Node]], path: str, *rest: object, description: str = "") -> Node:
        """A node whose id is its path, so that it is the same after each start."""
        title = ua.QualifiedName(path.rpartition(".")[2], self._index)
        node = await make(ua.NodeId(path, self._index), title, *rest)
        if description:
            text = ua.DataValue(ua.Variant(ua.LocalizedText(description)))
            await node.write_attribute(ua.AttributeIds.Description, text)
        return node

    async def _add_variable(self, folder: Node, path: str, value: Value) -> None:
        start = ua.get_default_value(value.kind)
        node = await self._add(folder.add_variable, path, start, value.kind, description=value.description)
        if value.unit:
            code = _UNITS[value.unit]
            information = ua.EUInformation(
                NamespaceUri="http://www.opcfoundation.org/UA/units/un/cefact",
                UnitId=int.from_bytes(code.encode(), "big"),
                DisplayName=ua.LocalizedText(value.unit),
                Description=ua.LocalizedText(code),
            )
            unit = ua.QualifiedName("EngineeringUnits")
            await node.add_property(ua.NodeId(f"{path}.EngineeringUnits", self._index), unit, information)
        self._values.append((node, value))

    async def _add_method(self, folder: Node, kind: Command | Order, text: str, command: Commander) -> None:
        async def called(_: ua.NodeId, *given: ua.Variant) -> ua.StatusCode | list[ua.Variant]:
            codes, values = ua.StatusCodes, [variant.Value for variant in given]
            # A client may send an array, or no value, of the right type.
            if [variant.VariantType for variant in given] != types or not all(isinstance(one, int) for one in values):
                return ua.StatusCode(codes.BadInvalidArgument)
            try:
                refused = await command(kind, *(values or [0]))
            except asyncio.TimeoutError:
                return ua.StatusCode(codes.BadTimeout)
            return ua.StatusCode(codes.BadInvalidState) if refused else []

        arguments, types = [], []
        if kind in ARGUMENTS:
            argument = ua.Argument()
            argument.Name, data_type, meaning = ARGUMENTS[kind]
            argument.DataType, argument.ValueRank = ua.NodeId(data_type.value), -1
            argument.Description = ua.LocalizedText(meaning)
            arguments, types = [argument], [data_type]
        path = f"{CELL}.Commands.{name(kind)}"
        await self._add(folder.add_method, path, called, arguments, [], description=text)
